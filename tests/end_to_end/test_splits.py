"""Splits in whole trials: test photographs change no training, and no search with validation."""

import csv
import shutil
from functools import partial
from shlex import split

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image

from tests.end_to_end.conftest import checksums, render_with_points, trial_of
from tests.helpers import read_json

pytestmark = pytest.mark.slow

QUICK = split(
    "scene=colmap densify=adc train.iterations=120 train.densify_start=20 "
    "train.densify_interval=20 train.densify_stop=100 eval.lpips=[] eval.flip=false "
    "tracking=none device=cpu"
)
TRAINED = ("point_cloud.ply", "events.jsonl", "lineage.npz")


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """A COLMAP folder with points from all views; a copy with noise as every eighth photograph."""
    folder = tmp_path_factory.mktemp("captures")
    clean, noisy = folder / "clean", folder / "noisy"
    render_with_points(clean, views=12)
    shutil.copytree(clean, noisy)
    rng = np.random.default_rng(0)
    for name in sorted(path.name for path in (noisy / "images").iterdir())[::8]:
        Image.fromarray(rng.integers(0, 256, (144, 192, 3), dtype=np.uint8)).save(
            noisy / f"images/{name}"
        )
    return clean, noisy


trial = partial(trial_of, QUICK)
bits = partial(checksums, names=TRAINED)


SIFT = "sfm init.first_octave=0 init.max_num_features=1500 init.two_view_tracks=true"


@pytest.mark.parametrize("init", [SIFT, "dataset"])
def test_test_photographs_do_not_change_one_bit_of_a_training(captures, tmp_path, init):
    """Poses are given here. Renders are equal, too, and only their photographs differ."""
    words = split(f"init={init} init.points_from=train")
    folders = [trial(tmp_path, capture, *words) for capture in captures]
    assert bits(folders[0]) == bits(folders[1])
    clean, noisy = (read_json(folder / "results.json") for folder in folders)
    assert clean["hashes"]["data"] != noisy["hashes"]["data"]
    assert clean["metrics"]["psnr"] > noisy["metrics"]["psnr"] + 3
    for render in (folders[0] / "renders").iterdir():
        assert_array_equal(Image.open(render), Image.open(folders[1] / f"renders/{render.name}"))


def test_a_sector_is_recorded_with_its_views_and_their_distances(captures, tmp_path):
    words = split("init=dataset densify=none scene.split=sector scene.sectors=4 scene.sector=3")
    folder = trial(tmp_path, captures[0], *words)
    results = read_json(folder / "results.json")
    assert results["split"] == "sector 3 of 4"
    assert "principal axis" in results["held_out"]
    assert (results["train_views"], results["test_views"]) == (9, 3)
    with (folder / "per_view.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    # the end of the arc
    assert [row["view"] for row in rows] == ["0009.png", "0010.png", "0011.png"]
    angles = [float(row["angle_to_nearest"]) for row in rows]
    assert angles == sorted(angles)
    assert 5 < angles[0] < 10 < angles[2] < 30
    assert "angle_to_nearest" not in results["metrics"]


def test_a_search_with_validation_views_never_sees_a_test_view(captures, tmp_path):
    """Noise in place of test photographs changes nothing, not even the fingerprint."""
    words = split("init=dataset densify=none scene.validation=true")
    clean, noisy = (trial(tmp_path, capture, *words) for capture in captures)
    one, other = (read_json(folder / "results.json") for folder in (clean, noisy))
    assert one["split"] == "every_nth, validation"
    assert one["hashes"]["data"] == other["hashes"]["data"]
    assert one["metrics"] == other["metrics"]
    assert bits(clean) == bits(noisy)
    assert "the 2 test views (every 8th image) put away unseen" in one["held_out"]
