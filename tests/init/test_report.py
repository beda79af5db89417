"""The report on models whose numbers are known."""

import math
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from gsbench.init import MODEL_FOLDER
from gsbench.init.base import PoseErrors
from gsbench.init.colmap.models import (
    align,
    align_poses,
    common_poses,
    compare_poses,
    training_extent,
)
from gsbench.init.report import make_report, measure_gauge, write_result
from gsbench.scene.colmap import posed_images
from gsbench.scene.types import Capture
from tests.init.models import add_point, camera_at, model_with
from tests.init.tables import TABLES

NAMES = ("a.png", "b.png", "c.png", "d.png")
CENTERS = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, 5.0, 0]])  # d is held out


def model_of(centers, turn=None, shift_px=0.0):
    """Cameras that look along +z, and two points that the first two cameras see.

    ``shift_px`` is the error of the observations in x.
    """
    points = np.array([[0.0, 0.0, 5.0], [0.5, 0.5, 6.0]])
    rotation = (turn or Rotation.identity()).as_matrix()
    keypoints = {}
    for name, center in zip(NAMES, centers, strict=True):
        local = (points - center) @ rotation.T
        keypoints[name] = 100 * local[:, :2] / local[:, 2:] + [50 + shift_px, 40]
    poses = {name: camera_at(at, rotation) for name, at in zip(NAMES, centers, strict=True)}
    model = model_with(poses, keypoints)
    for index, point in enumerate(points):
        add_point(model, point, seen_by={1: index, 2: index})
    model.update_point_3d_errors()
    return model


@pytest.fixture
def capture(tmp_path):
    return Capture("hand", tmp_path, NAMES, ("d.png",), None, False, "0")


def test_extent_is_that_of_the_training_cameras(capture):
    # the mean of a, b and c is (0, 1/3, 0); a and b are sqrt(1 + 1/9) away
    assert training_extent(model_of(CENTERS), capture) == pytest.approx(1.1 * math.sqrt(1 + 1 / 9))


def test_the_gauge_expresses_the_threshold_of_the_paper():
    gauge = measure_gauge(2.0, 0.5)
    assert 4 / 3 * math.pi * gauge.threshold_radius**3 == pytest.approx(0.03)
    assert gauge.threshold_over_extent_cubed == pytest.approx(0.03 / 8)
    assert gauge.threshold_radius_over_extent == pytest.approx(gauge.threshold_radius / 2)
    assert measure_gauge(0.0, None).threshold_over_extent_cubed is None


def reported(capture, model, packages=(), **more):
    """The report on a model whose poses were estimated."""
    return make_report("x", "own", capture, model, packages, settings={}, seconds={}, **more)


def test_a_report_has_the_numbers_of_its_model(capture):
    model, capture = model_of(CENTERS, shift_px=0.75), replace(capture, image_names=(*NAMES, "e"))
    report = reported(capture, model, ("pycolmap",), counts={"features": 7})
    assert report.counts == {"features": 7}
    assert (report.num_images, report.num_registered, report.num_points) == (5, 4, 2)
    assert report.unregistered == ("e",)
    assert report.mean_reprojection_error == pytest.approx(0.75)
    assert report.mean_track_length == 2.0
    assert report.focal_lengths == (100.0,)
    assert report.versions["pycolmap"] == pycolmap.__version__


def test_doubts_about_a_model_are_measured_and_recorded(capture):
    """The limits stand in gsbench.scene.rules."""
    model = model_of(CENTERS, shift_px=2.0)
    known = PoseErrors(4, False, 0.1, 0.06, 3.0, 90.0)
    report = reported(replace(capture, image_names=tuple("abcdefgh")), model, pose_errors=known)
    found = {odd.rule: odd.value for odd in report.oddities}
    wanted = {"few-placed": 0.5, "few-points": 2, "reprojection-error": 2.0}
    wanted |= {"cameras-turned": 3.0, "cameras-moved": 0.06}
    assert found == pytest.approx(wanted)
    assert report.to_dict()["oddities"][0]["rule"] == "few-placed"


@pytest.mark.parametrize("focal, view", TABLES["fields of view"])
def test_a_field_of_view_outside_5_to_150_degrees_gives_a_warning(capture, focal, view):
    """Along the longest side, 100 px, it is 2 atan(50 / focal)."""
    assert math.degrees(2 * math.atan(50 / focal)) == pytest.approx(view, abs=0.05)
    model = model_of(CENTERS)
    model.cameras[1].params = [focal, focal, 50.0, 40.0]
    report = reported(capture, model)
    assert any("implausible" in odd.line for odd in report.oddities) == (not 5 < view < 150)


def test_two_common_cameras_are_not_compared_and_give_a_warning(capture):
    """A similarity needs at least three."""
    model, reference = model_of(CENTERS), model_of(CENTERS)
    for image_id in (3, 4):
        reference.deregister_frame(reference.images[image_id].frame_id)
    found = align(model, reference, capture, False, True)
    assert ["too few common cameras" in line for line in found.pop("warnings")] == [True]
    assert found == align(model, None, capture, False, True) == {}


@pytest.mark.parametrize("move", [True, False])
def test_an_estimated_model_is_written_in_the_gauge_of_the_reference_or_its_own(
    capture, tmp_path, move
):
    model, shift = model_of(CENTERS), np.array([1.0, 2.0, 3.0])
    model.transform(pycolmap.Sim3d(3.0, pycolmap.Rotation3d(), shift))
    poses = {name: camera_at(at) for name, at in zip(NAMES, CENTERS, strict=True)}
    others = model_with(dict(reversed(poses.items())))  # paired by name, not by number
    report = reported(capture, model, **align(model, others, capture, False, move))
    write_result(model, report, tmp_path)
    assert report.gauge.scale_to_reference == pytest.approx(1.0 if move else 1 / 3)
    found = posed_images(pycolmap.Reconstruction(tmp_path / MODEL_FOLDER))
    places = [found[name].projection_center() for name in NAMES]
    assert_allclose(places, CENTERS if move else 3 * CENTERS + shift, atol=1e-9)


def test_centre_errors_are_in_reference_units_and_relative_to_the_extent():
    moved = CENTERS.copy()
    moved[3, 2] += 0.3
    model, reference = model_of(moved), model_of(CENTERS)
    same = align_poses(*common_poses(reference, reference))
    found = compare_poses(common_poses(model, reference), same, 2.0, exact=True)
    assert found.center_rmse == pytest.approx(0.3 / 2)
    assert found.center_rmse_relative == pytest.approx(0.3 / 4)
