"""Scenes and cameras for timing."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from gsbench.bench.scenes import (
    SCENES,
    camera_before,
    frontal_camera,
    make_scene,
    trained_like_gaussians,
)
from gsbench.gaussians.ply import write_ply
from gsbench.raster.reference import ReferenceRasterizer
from tests.gaussians.helpers import random_gaussians


def test_the_camera_before_a_scene_is_at_twice_the_median_distance_from_its_middle():
    scene = random_gaussians(5)
    middle = torch.tensor([2.0, -1.0, 30.0])
    offsets = torch.tensor([[0.0, 0, 0], [3, 4, 0], [-3, -4, 0], [0, 0, 9], [0, 0, -9]])
    scene.means = middle + offsets  # distances 0, 5, 5, 9, 9
    camera = camera_before(scene, 60, 45)
    assert_allclose(camera.translation, [-2, 1, -30 + 10], atol=1e-6)
    for one in (camera, frontal_camera(60, 45)):
        assert (one.width, one.height, one.cx, one.cy) == (60, 45, 30, 22.5)
        assert one.fx == one.fy == 54
        assert_array_equal(one.rotation, np.eye(3))
    assert_array_equal(one.translation, np.zeros(3))


@pytest.mark.parametrize("make", SCENES.values(), ids=SCENES)
def test_scenes_have_the_wanted_count_and_are_repeatable_and_seen(make):
    scene = make(500)
    assert len(scene) == 500
    assert torch.equal(scene.means, make(500).means)
    for camera in (frontal_camera(60, 45), camera_before(scene, 60, 45)):
        output = ReferenceRasterizer().render(scene, camera, 3, torch.zeros(3))
        assert 0.3 < output.visible.float().mean() <= 1
        assert output.alpha.mean() > 0.3
    assert len(make(1)) == 1


@pytest.mark.parametrize(
    "kind, sums",
    [
        ("trained", [7186.741, 3253.378, 1569.597, 919.4365, 735.6435, 1804.961]),
        ("crowded", [7076.649, 3253.378, 1569.597, 919.4365, 735.6435, 1804.961]),
    ],
)
def test_scenes_do_not_change(kind, sums):
    """Measurements of different versions compare times of the same Gaussians."""
    found = [tensor.double().abs().sum().item() for tensor in SCENES[kind](500).tensors().values()]
    assert found == pytest.approx(sums, rel=1e-6)


def test_a_scene_for_timing_has_two_views_of_noise(tmp_path):
    gaussians, scene = make_scene("trained", 60, 45, 30)
    assert torch.equal(gaussians.means, trained_like_gaussians(30).means)
    assert ([view.name for view in scene.train], scene.test) == (["0.png", "1.png"], ())
    one, other = (view.image for view in scene.train)
    assert (one.shape, one.min(), one.max()) == ((45, 60, 3), 0, 255)
    assert (one != other).any()
    write_ply(gaussians, tmp_path / "m.ply")
    model, scene = make_scene("unused", 60, 45, 7, tmp_path / "m.ply")
    assert torch.equal(model.means, gaussians.means)
    wanted = camera_before(gaussians, 60, 45).translation
    assert_array_equal(scene.train[1].camera.translation, wanted)
