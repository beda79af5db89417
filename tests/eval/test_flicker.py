"""Flicker of a wall whose picture from any camera is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gsbench.eval.flicker import camera_path, flicker
from gsbench.scene.camera import Camera

WALL = 4.0  # its depth, at z = 4


def camera_at(x: float, turn: float = 0.0) -> Camera:
    rotation = Rotation.from_euler("y", turn, degrees=True).as_matrix()
    return Camera(60, 40, 50.0, 50.0, 30.0, 20.0, rotation, -rotation @ np.array([x, 0.0, 0.0]))


def wall(camera: Camera, brightness: float = 0.0) -> tuple[torch.Tensor, np.ndarray, torch.Tensor]:
    """(picture [H, W, 3], world points [H, W, 3], depth [H, W]) of a smoothly painted wall."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack(
        [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], -1
    )  # of depth 1 in the camera
    directions = rays @ camera.rotation
    depth = (WALL - camera.center[2]) / directions[..., 2]
    points = camera.center + directions * depth[..., None]
    paint = 0.5 + 0.2 * np.sin(2 * points[..., :1] + np.array([0, 1, 2])) * np.cos(3 * points[..., 1:2]) + brightness
    return torch.from_numpy(paint), points, torch.from_numpy(depth)


@pytest.mark.parametrize("turn", [0.0, -1.5])
def test_a_wall_that_stays_as_it_is_does_not_flicker(turn: float) -> None:
    one, other = camera_at(0.0), camera_at(0.13, turn)
    (frame, points, _), (following, _, depth) = wall(one), wall(other)
    assert flicker(frame, points, following, depth, other) < 0.25  # what the cubic rounds off
    assert float((following - frame).abs().mean()) * 255 > 2  # the pictures do differ: the camera moved


def test_a_wall_that_changes_flickers_by_as_much() -> None:
    one, other = camera_at(0.0), camera_at(0.13)
    (frame, points, _), (following, _, depth) = wall(one), wall(other, 10 / 255)
    assert flicker(frame, points, following, depth, other) == pytest.approx(10, abs=0.1)


def test_what_is_hidden_or_outside_does_not_count() -> None:
    one, other = camera_at(0.0), camera_at(0.13)
    (frame, points, _), (following, _, depth) = wall(one), wall(other)
    depth[:, :30], following[:, :30] = 1.0, 1.0  # something white comes before the left half
    assert flicker(frame, points, following, depth, other) < 0.25
    points[:, 40:] = math.nan  # and of the right no surface is known
    following[:, 42:] = 0.0
    assert flicker(frame, points, following, depth, other) < 0.25
    away = camera_at(100.0)
    assert math.isnan(flicker(frame, points, following, depth, away))


def test_a_path_begins_and_ends_where_it_should() -> None:
    start, end = camera_at(0.0), camera_at(1.0, 40.0)
    path = camera_path(start, end, [0.0, 0.25, 1.0])
    assert np.allclose(path[0].rotation, start.rotation)
    assert np.allclose(path[2].rotation, end.rotation)
    assert np.allclose([camera.center for camera in path], [[0, 0, 0], [0.25, 0, 0], [1, 0, 0]])
    assert Rotation.from_matrix(path[1].rotation).magnitude() == pytest.approx(np.radians(10))
    assert (path[1].width, path[1].fx) == (60, 50)
