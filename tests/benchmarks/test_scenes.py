"""Scenes and cameras for timing."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsbench.bench.scenes import SCENES, camera_before, frontal_camera
from gsbench.errors import InputError
from tests.gaussians.helpers import random_gaussians


def test_the_camera_before_a_scene_is_at_twice_the_median_distance_from_its_middle() -> None:
    scene = random_gaussians(5)
    middle = torch.tensor([2.0, -1.0, 30.0])
    offsets = torch.tensor([[0.0, 0, 0], [3, 4, 0], [-3, -4, 0], [0, 0, 9], [0, 0, -9]])
    scene.means = middle + offsets  # distances 0, 5, 5, 9, 9
    camera = camera_before(scene, 60, 45)
    assert (camera.width, camera.height, camera.cx, camera.cy) == (60, 45, 30, 22.5)
    np.testing.assert_allclose(camera.translation, [-2, 1, -30 + 10], atol=1e-6)
    np.testing.assert_array_equal(camera.rotation, np.eye(3))


@pytest.mark.parametrize("kind", SCENES)
def test_scenes_have_the_wanted_count_in_front_of_the_camera(kind: str) -> None:
    scene = SCENES[kind](40)
    assert len(scene.means) == 40
    camera = frontal_camera(60, 45)
    x, y, z = (scene.means.double().numpy() @ camera.rotation.T + camera.translation).T
    assert (z > 0).all()
    within = np.abs(x * camera.fx / z) < camera.width
    assert (within & (np.abs(y * camera.fy / z) < camera.height)).all()
    assert abs((x / z).mean()) < 0.25  # around the middle of the picture
    assert abs((y / z).mean()) < 0.25
    with pytest.raises(InputError, match="count must be at least 1, got 0"):
        SCENES[kind](0)
