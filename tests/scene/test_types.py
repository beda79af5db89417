"""Cameras: values that are refused, centres, and resizing, which changes no direction."""

import numpy as np
import pytest

from gsbench.scene.types import Camera, CameraModel, to_pinhole
from tests.scene.cameras import looking
from tests.scene.tables import TABLES

SOUND = {
    **{"width": 1, "height": 1, "fx": 1e-3, "fy": 1e-3, "cx": -5.0, "cy": 0.0},
    **{"rotation": np.eye(3), "translation": np.zeros(3)},
}


@pytest.mark.parametrize("name, value", TABLES["impossible cameras"])
def test_impossible_values_of_a_camera_are_refused(name, value):
    Camera(**SOUND)  # one pixel is a picture
    with pytest.raises(ValueError, match="camera: "):
        Camera(**(SOUND | {name: value}))


def test_rotation_and_translation_become_float64():
    turn = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    camera = Camera(**(SOUND | {"rotation": turn, "translation": [1, 2, 3]}))
    assert camera.rotation.dtype == camera.translation.dtype == np.float64
    assert camera.center.tolist() == [-2, 1, -3]


def test_one_focal_length_is_used_for_both_axes():
    for model, params in (
        ("SIMPLE_PINHOLE", (50.0, 20.0, 15.0)),
        ("PINHOLE", (50.0, 50.0, 20.0, 15.0)),
    ):
        camera = to_pinhole(CameraModel(model, 40, 30, params))
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50.0, 50.0, 20.0, 15.0)
        assert (camera.width, camera.height) == (40, 30)
        assert not camera.center.any()


def test_a_point_keeps_its_relative_place_in_a_resized_image():
    camera = looking(np.array([3.0, -2.0, 1.5]), np.zeros(3), size=(64, 48))
    x, y, z = camera.rotation @ [0.1, 0.2, 0.3] + camera.translation
    places = [
        ((one.fx * x / z + one.cx) / one.width, (one.fy * y / z + one.cy) / one.height)
        for one in (camera, camera.resized(17, 60))
    ]
    assert places[0] == pytest.approx(places[1])
