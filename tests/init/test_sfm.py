"""Structure from motion on a scene whose cameras and surfaces are known exactly."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_array_equal
from PIL import Image

from gsbench.init import MODEL_FOLDER, Sfm, SfmDense, read_cloud, sfm
from gsbench.init.base import REPORT_FILE, WORK_FOLDER, Timer, UnplacedError
from gsbench.init.sfm import Job
from gsbench.logs import no_progress
from gsbench.scene.types import Capture
from tests.helpers import read_json, refusal
from tests.init.models import camera_at, digest, model_with
from tests.init.tables import TABLES
from tests.scene.courtyard.surfaces import surface_distance


def capture_of(folder):
    names = tuple(sorted(path.name for path in folder.iterdir()))
    return Capture("photos", folder, names, (), None, False, "0")


@pytest.fixture(scope="module")
def own(courtyard, tmp_path_factory):
    output = tmp_path_factory.mktemp("own")
    return Sfm(poses="own").run(courtyard, output), output


@pytest.fixture(scope="module")
def told():
    """The progress that the run of the fixture ``shared`` reported."""
    return []


@pytest.fixture(scope="module")
def shared(courtyard, told, tmp_path_factory):
    output = tmp_path_factory.mktemp("shared")

    def tell(phase, done, total, note=""):
        told.append((phase, done, total))

    return Sfm().run(courtyard, output, tell), output


def test_own_poses_agree_with_the_exact_ones(own):
    report, _ = own
    assert report.num_registered == report.num_images == 8
    assert report.pose_errors.exact
    assert report.pose_errors.center_rmse < 0.02  # m, on a ring of 4.5 m radius
    # cameras on an arc of 52 degrees determine the rotation about the arc weakly
    assert report.pose_errors.rotation_max_deg < 1.5
    assert report.focal_lengths[0] == pytest.approx(300.9, rel=0.01)  # 320 / (2 tan 28 degrees)
    assert report.mean_reprojection_error < 0.5
    assert report.warnings == ()


def test_known_poses_give_points_on_the_true_surfaces(shared, courtyard):
    report, output = shared
    assert report.poses == "shared"
    assert report.pose_errors is None
    # m; a pixel covers 0.015 m
    assert np.median(surface_distance(read_cloud(output / MODEL_FOLDER).points)) < 0.02
    model = pycolmap.Reconstruction(output / MODEL_FOLDER)
    exact = pycolmap.Reconstruction(courtyard.model)
    for image in exact.images.values():  # the cameras equal the reference's, bit for bit
        found = model.find_image_with_name(image.name).cam_from_world()
        assert_array_equal(found.matrix(), image.cam_from_world().matrix())


def test_output_is_complete_and_the_work_folder_is_gone(shared):
    report, output = shared
    assert read_json(output / REPORT_FILE) == report.to_dict()
    assert report.to_dict()["settings"]["peak_threshold"] == pytest.approx(0.02 / 3)
    assert {"extract", "match", "triangulate"} == set(report.seconds)
    assert not (output / WORK_FOLDER).exists()


def test_the_progress_of_each_phase_is_reported_from_start_to_end(shared, told):
    phases = {phase: [state for state in told if state[0] == phase] for phase, _, _ in told}
    assert list(phases) == ["extract", "match", "triangulate"]
    for (_, first, _), *_, (_, last, total) in phases.values():
        assert (first, last) == (0, total)
    assert [states[-1][2] for states in phases.values()] == [8, 28, 1]


@pytest.mark.parametrize("poses, points_from, names, needed", TABLES["images and references"])
def test_poses_and_points_from_choose_the_photographs_and_the_need_for_a_reference(
    poses, points_from, names, needed
):
    """There are four photographs; b is a test view, and a is not in the reference."""
    options = SfmDense(poses=poses, points_from=points_from)
    capture = Capture("x", Path("x"), ("a", "b", "c", "d"), ("b",), None, False, "0")
    reference = model_with({name: camera_at([0, 0, 0]) for name in "dcb"})
    assert options.select_images(capture, reference) == list(names)
    assert options.select_images(capture, None) == list("abcd")
    assert options.needs_reference(capture) == needed
    assert not options.needs_reference(replace(capture, model=Path("m")))


@pytest.mark.slow
def test_two_runs_are_equal_bit_for_bit_on_any_number_of_threads(own, courtyard, tmp_path):
    _, first = own
    Sfm(poses="own", threads=3).run(courtyard, tmp_path)
    assert digest(tmp_path / MODEL_FOLDER) == digest(first / MODEL_FOLDER)


@pytest.mark.slow
def test_bare_photos_get_poses_of_their_own_and_serve_as_reference(bare_photos, tmp_path):
    assert not Sfm().needs_reference(bare_photos)
    report = Sfm().run(bare_photos, tmp_path / "sfm")
    assert report.poses == "own"
    assert report.pose_errors is None
    assert report.gauge.scale_to_reference is None
    assert SfmDense().needs_reference(bare_photos)
    reference = tmp_path / "sfm" / MODEL_FOLDER
    dense = SfmDense().run(bare_photos, tmp_path / "dense", reference=reference)
    assert dense.poses == "shared"
    assert dense.gauge.scene_extent == pytest.approx(report.gauge.scene_extent, rel=1e-12)
    assert dense.num_points > report.num_points
    with refusal("init=sfm_dense takes its cameras from a reference"):
        SfmDense().run(bare_photos, tmp_path / "without")


@pytest.mark.slow
def test_webp_photos_give_the_same_points_as_png_photos(courtyard, tmp_path):
    """COLMAP cannot read WebP; lossless copies must lead to the same points."""
    images = tmp_path / "images"
    images.mkdir()
    for index, name in enumerate(courtyard.image_names):
        target = (images / name).with_suffix(".webp" if index % 2 else ".png")
        Image.open(courtyard.images / name).save(target, lossless=True)
    Sfm().run(capture_of(images), tmp_path / "webp")
    Sfm().run(replace(courtyard, model=None), tmp_path / "png")
    first, second = (read_cloud(tmp_path / kind / MODEL_FOLDER) for kind in ("webp", "png"))
    assert_array_equal(first.points, second.points)
    assert_array_equal(first.colors, second.colors)


@pytest.mark.parametrize(
    "pixels, said",
    [
        ([np.full((60, 80, 3), 40 * index) for index in range(3)], "no keypoint in any image"),
        (
            np.random.default_rng(0).integers(0, 255, (3, 60, 80, 3)),
            "no pair of images shares enough matches",
        ),
    ],
)
def test_photos_that_cannot_be_matched_are_refused(tmp_path, pixels, said):
    for index, own in enumerate(pixels):
        Image.fromarray(own.astype(np.uint8)).save(tmp_path / f"{index}.png")
    with refusal(said):
        Sfm().run(capture_of(tmp_path), tmp_path.with_name("out"))


@pytest.mark.parametrize("pairs, count, auto, every, poses, kept", TABLES["pairs"])
def test_all_pairs_are_matched_if_those_of_auto_place_few_images(
    monkeypatch, caplog, pairs, count, auto, every, poses, kept
):
    def attempt(job, *_):
        placed = every if job.options.pairs == "exhaustive" else auto
        if placed is None:
            raise UnplacedError("no pair")
        return job.options, SimpleNamespace(num_reg_images=lambda: placed), {"poses": poses}

    monkeypatch.setattr(sfm, "_attempt", attempt)
    names = tuple(map(str, range(count)))
    capture = Capture("x", Path("x"), names, (), None, False, "0")
    job = Job(Sfm(pairs=pairs), capture, Path("x"), Path("x"), None)
    try:
        options, *_ = sfm._best_attempt(job, None, Timer(), no_progress)
    except UnplacedError:
        assert kept is None
    else:
        assert options.pairs == kept
    tried_again = pairs == "auto" and count == 40 and poses == "own" and auto != 36
    assert ("the others are matched" in caplog.text) == tried_again
