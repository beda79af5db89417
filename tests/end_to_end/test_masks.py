"""Masks in whole trials: ignored pixels change nothing, and an edited mask makes a new trial."""

import csv
import shutil
from functools import partial
from shlex import split

import numpy as np
import pycolmap
import pytest
from PIL import Image

from gsbench.files import file_sha256
from gsbench.init import Dim, Sfm
from gsbench.init.base import MODEL_FOLDER
from gsbench.scene.beside import read_mask
from gsbench.scene.colmap import read_model
from gsbench.scene.courtyard.render import render_courtyard
from tests.end_to_end.conftest import checksums, trial_of
from tests.helpers import read_json
from tests.scene.captures import read_colmap

pytestmark = pytest.mark.slow

SIZE = 192, 144
QUICK = split(
    "scene=colmap densify=adc train.iterations=80 train.densify_start=20 "
    "train.densify_interval=20 train.densify_stop=70 eval.download=false eval.lpips=[] "
    "tracking=none device=cpu scene.masks=masks"
)
SIFT = split("init=sfm init.first_octave=0 init.max_num_features=1500 init.two_view_tracks=true")
SAME = ("point_cloud.ply", "events.jsonl", "lineage.npz", "per_view.csv")


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """A COLMAP folder with masks of a moving disc and a margin; the same with noise below them."""
    folder = tmp_path_factory.mktemp("masked")
    clean, noisy = folder / "clean", folder / "noisy"
    width, height = SIZE
    render_courtyard(clean, views=10, width=width, height=height)
    rows, columns = np.mgrid[:height, :width]
    (clean / "masks").mkdir()
    names = sorted(path.name for path in (clean / "images").iterdir())
    for place, name in enumerate(names):
        ignored = ((rows - 70) ** 2 + (columns - 40 - 10 * place) ** 2 < 30**2) | (rows > 130)
        Image.fromarray(np.where(ignored, 0, 255).astype(np.uint8)).save(
            clean / f"masks/{name}.png"
        )
    shutil.copytree(clean, noisy)
    rng = np.random.default_rng(0)
    for name in names:
        ignored = np.asarray(Image.open(clean / f"masks/{name}.png")) == 0
        pixels = np.array(Image.open(clean / f"images/{name}"))
        pixels[ignored] = rng.integers(0, 256, (ignored.sum(), 3))
        Image.fromarray(pixels).save(noisy / f"images/{name}")
    return clean, noisy


trial = partial(trial_of, QUICK)


@pytest.mark.parametrize(
    "words",
    [
        SIFT,
        [*SIFT, "scene.max_size=96"],
        split("init=random densify=taming init.count=3000 densify.max_gaussians=6000"),
        ["init=random", "densify=fastgs"],
    ],
)
def test_ignored_pixels_do_not_change_one_bit_of_a_trial(captures, tmp_path, words):
    folders = [trial(tmp_path, capture, *words) for capture in captures]
    bits = [checksums(folder, SAME, "renders", "masks") for folder in folders]
    assert bits[0] == bits[1]
    clean, noisy = (read_json(folder / "results.json") for folder in folders)
    assert clean["hashes"]["data"] != noisy["hashes"]["data"]
    for key in split("metrics num_init_points num_gaussians causes events"):
        assert clean.get(key) == noisy.get(key), key
    clouds = [_points(folder) for folder in folders]
    assert clouds[0] == clouds[1]
    with (folders[0] / "per_view.csv").open() as stream:
        shares = [float(row["counted"]) for row in csv.DictReader(stream)]
    assert all(0.5 < share < 0.9 for share in shares)


def _points(folder):
    """The digests of the trial's initial cloud and cameras."""
    key = read_json(folder / "results.json")["hashes"]["init"]
    return checksums(folder.parents[3] / f"store/init/{key}", [], MODEL_FOLDER)


def test_without_masks_the_noise_changes_the_trial(captures, tmp_path):
    """This shows that the test above can fail."""
    clean, noisy = (trial(tmp_path, capture, *SIFT, "scene.masks=null") for capture in captures)
    assert file_sha256(clean / "point_cloud.ply") != file_sha256(noisy / "point_cloud.ply")
    assert "counted" not in (clean / "per_view.csv").read_text()
    assert not (clean / "masks").exists()


def test_an_edited_mask_makes_a_new_trial_and_the_old_mask_finds_the_old_one(
    captures, tmp_path, capsys
):
    capture = tmp_path / "edited"
    shutil.copytree(captures[0], capture)
    words = split("init=random init.count=500 densify=none train.iterations=5")
    folder = trial(tmp_path / "runs", capture, *words)
    first = read_json(folder / "results.json")
    mask = sorted((capture / "masks").iterdir())[3]  # of a training view
    before = mask.read_bytes()
    pixels = np.array(Image.open(mask))
    pixels[:60] = 0
    Image.fromarray(pixels).save(mask)
    capsys.readouterr()
    trial(tmp_path / "runs", capture, *words)
    assert "already done" not in capsys.readouterr().err
    second = read_json(folder / "results.json")
    assert first["hashes"]["train"] != second["hashes"]["train"]
    assert first["hashes"]["config"] == second["hashes"]["config"]
    mask.write_bytes(before)
    trial(tmp_path / "runs", capture, *words)
    assert read_json(folder / "results.json")["hashes"] == first["hashes"]


@pytest.mark.parametrize("make", [Sfm, Dim])
def test_no_keypoint_lies_on_an_ignored_pixel(captures, tmp_path, make, request):
    """Without `prepare`, there are features below the masks that could be found."""
    options = {"init": {"first_octave": 0, "max_num_features": 1500}, "net": {"max_keypoints": 500}}
    words = options["init" if make is Sfm else "net"] | {"two_view_tracks": True}
    if make is Dim:
        words |= {"extractor": "aliked", "matcher": "mutual_nearest"}
        words |= {"download": False, "weights": request.getfixturevalue("shared") / "weights"}
    capture = read_colmap(captures[0], masks="masks")
    work = tmp_path / "work"
    try:
        make(threads=1, **words).run(capture, tmp_path / "out", work_dir=work)
    except Exception as error:
        if make is Dim and "weights" in str(error):
            pytest.skip(str(error))
        raise
    seen = 0
    with pycolmap.Database.open(work / "database.db") as database:
        for image in database.read_all_images():
            points = np.floor(database.read_keypoints(image.image_id)[:, :2]).astype(int)
            counts = read_mask(capture.masks[image.name])
            height, width = counts.shape
            inside = counts[points[:, 1].clip(0, height - 1), points[:, 0].clip(0, width - 1)]
            assert inside.all(), image.name
            seen += len(points)
    assert seen > 200
    assert len(read_model(tmp_path / f"out/{MODEL_FOLDER}").points3D) > 0
