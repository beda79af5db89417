"""Initialisers that need no matching."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from gsbench.gaussians.ply import read_ply, write_ply
from gsbench.init import MODEL_FOLDER, Dataset, Ply, Random, read_cloud
from gsbench.init.base import GAUSSIANS_FILE, REPORT_FILE, TrainingPoints
from gsbench.scene.types import Capture
from tests.gaussians.helpers import random_gaussians
from tests.helpers import read_json, refusal
from tests.init.models import add_point, model_with
from tests.init.test_report import CENTERS, NAMES, model_of

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def in_process(monkeypatch):
    """Compute models in this process; the tests without this fixture start another."""
    monkeypatch.setattr(
        "gsbench.init.placed.run_isolated", lambda build, *given, what: build(*given)
    )


def add_points(model_dir, target, count):
    """A copy of the model with points that the first three images see."""
    model = pycolmap.Reconstruction(model_dir)
    points = np.random.default_rng(0).uniform(-1, 1, (count, 3))
    images = [image for _, image in sorted(model.images.items())]
    seen = {image.name: np.array([*map(image.project_point, points)]) for image in images}
    poses = {image.name: image.cam_from_world() for image in images}
    copy = model_with(poses, seen, model.cameras[1])
    for index, point in enumerate(points):
        add_point(copy, point, (index, 2 * index, 255 - index), dict.fromkeys((1, 2, 3), index))
    target.mkdir(parents=True)
    copy.write_binary(target)
    return points


def test_dataset_keeps_the_cloud_of_the_model(courtyard, tmp_path):
    points = add_points(courtyard.model, tmp_path / "model", 20)
    report = Dataset().run(replace(courtyard, model=tmp_path / "model"), tmp_path / "out")
    cloud = read_cloud(tmp_path / "out" / MODEL_FOLDER)
    assert_allclose(cloud.points, points)
    assert_array_equal(cloud.colors[:, 1], 2 * np.arange(20))
    assert report.num_points == 20
    assert report.mean_track_length == 3.0
    assert any("only 20 points" in odd.line for odd in report.oddities)


def test_the_dataset_s_points_may_come_from_training_views_alone(courtyard, tmp_path, in_process):
    """The first of the three images that see all points is a test view."""
    add_points(courtyard.model, tmp_path / "model", 20)
    capture, out = replace(courtyard, model=tmp_path / "model"), tmp_path / "out"
    report = Dataset(points_from="train").run(capture, out)
    assert report.training_points == TrainingPoints("train", 20, 20, 0.0)
    assert report.mean_track_length == 2.0
    assert read_json(out / REPORT_FILE)["training_points"]["kept"] == 20
    assert {path.name for path in out.iterdir()} == {"sparse", REPORT_FILE}
    few = replace(capture, test_names=capture.image_names[:2])
    with refusal("init.points_from=train: no point is left that two training views see"):
        Dataset(points_from="train").run(few, out)


@pytest.mark.parametrize("seen_by", [1, 3])
def test_the_example_carved_keeps_points_in_view_of_enough_cameras(courtyard, seen_by, monkeypatch):
    """Checked with COLMAP's projection, one point and one image at a time."""
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    from carved import Carved

    options = {"count": 300, "size": 2.0, "seed": 3}
    model = pycolmap.Reconstruction(courtyard.model)
    images = [image for image in model.images.values() if image.name in courtyard.train_names]
    expected = []
    for point in Random(**options).cloud(courtyard, model).points:
        pixels = [(image.project_point(point), model.cameras[image.camera_id]) for image in images]
        views = sum(
            pixel is not None and 0 <= pixel[0] < camera.width and 0 <= pixel[1] < camera.height
            for pixel, camera in pixels
        )
        if views >= seen_by:
            expected.append(point)
    carved = Carved(**options, seen_by=seen_by).cloud(courtyard, model)
    assert_array_equal(carved.points, expected)
    assert 0 < len(expected) < 300


def test_dataset_needs_points_and_a_model(courtyard, bare_photos, tmp_path, in_process):
    with refusal("has no points: use init=sfm"):
        Dataset().run(courtyard, tmp_path)
    for made in (Dataset(), Random()):
        with refusal(f"init={made.name} needs cameras"):
            made.run(bare_photos, tmp_path)


def test_random_draws_points_and_colours_around_the_training_cameras_alone(tmp_path):
    """By hand: their mean is (0, 1/3, 0), and the farthest are sqrt(10) / 3 away from it."""
    capture = Capture("hand", tmp_path, NAMES, ("d.png",), None, False, "0")
    clouds = [
        Random(count=5000, size=2.0, seed=seed).cloud(capture, model_of(CENTERS))
        for seed in (3, 3, 4)
    ]
    offset = (clouds[0].points - [0, 1 / 3, 0]) / (2.0 * 1.1 * 10**0.5 / 3)
    assert 0.99 < np.abs(offset).max() <= 1.0
    assert np.abs(offset.mean(axis=0)).max() < 0.03
    assert np.abs(offset).mean() == pytest.approx(0.5, abs=0.01)
    assert len(np.unique(clouds[0].colors)) == 256
    assert_array_equal(clouds[0].points, clouds[1].points)
    assert not np.allclose(clouds[0].points, clouds[2].points)
    with refusal("training cameras of scene hand are all at one place"):
        Random().cloud(capture, model_of(np.zeros((4, 3))))


def test_random_needs_cameras(bare_photos, courtyard, tmp_path):
    assert Random().needs_reference(bare_photos)
    report = Random(count=10).run(bare_photos, tmp_path, reference=courtyard.model)
    assert (report.num_points, report.mean_reprojection_error) == (10, None)
    assert "NaN" not in (tmp_path / "report.json").read_text()


def test_reading_a_cloud_without_a_model_is_refused(tmp_path):
    with refusal("no COLMAP model here"):
        read_cloud(tmp_path)


def test_a_trained_model_becomes_points_and_is_copied_unchanged(
    courtyard, tmp_path, caplog, in_process
):
    gaussians = random_gaussians(20, dtype=torch.float32)
    gaussians.opacity_logits[0] = torch.inf
    write_ply(gaussians, tmp_path / "model.ply")
    assert Ply(path=str(tmp_path / "model.ply")).run(courtyard, tmp_path / "out").num_points == 20
    cloud = read_cloud(tmp_path / "out" / MODEL_FOLDER)
    assert_allclose(cloud.points, gaussians.means.double().numpy())
    red = 0.5 + 0.28209479177387814 * gaussians.sh_dc[:, 0].numpy()  # Y00 = 1 / (2 sqrt(pi))
    assert_allclose(cloud.colors[:, 0] / 255, red.clip(0, 1), atol=0.5 / 255 + 1e-6)
    assert caplog.text.count("opacity of exactly 0 or 1") == 1  # the file is read once
    assert torch.equal(read_ply(tmp_path / "out" / GAUSSIANS_FILE).log_scales, gaussians.log_scales)
    with refusal(r"init\.path=nowhere\.ply"):
        Ply(path="nowhere.ply")
    (tmp_path / "words.ply").write_text("no model")
    with refusal(r"words\.ply: not a readable PLY of Gaussians \(it has no header\)"):
        Ply(path=str(tmp_path / "words.ply"))  # refused before any photograph is read
