"""Depths, surfaces and floaters on cases small enough to work out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gsbench.eval.geometry import (
    completeness,
    depth_error,
    floater_share,
    in_front,
    point_depth_error,
    project,
    share_beyond,
)
from gsbench.scene.camera import Camera

NAN, SKY = math.nan, math.inf
CAMERA = Camera(20, 10, 10.0, 10.0, 10.0, 5.0, np.eye(3), np.zeros(3))  # at the origin, looks along z


def test_depth_error_counts_where_both_show_a_surface() -> None:
    depth = np.array([[2.2, NAN, 5.0, 4.0]])
    truth = np.array([[2.0, 3.0, SKY, 5.0]])
    assert depth_error(depth, truth) == pytest.approx((0.1 + 0.2) / 2)
    assert math.isnan(depth_error(np.array([[NAN]]), np.array([[1.0]])))


def test_share_beyond_is_strict() -> None:
    assert share_beyond(np.array([0.0, 0.05, 0.0501, 1.0]), 0.05) == 0.5
    assert math.isnan(share_beyond(np.zeros(0), 0.05))


def test_completeness_is_that_of_brute_force_and_of_one_direction() -> None:
    rng = np.random.default_rng(0)
    truth, points = rng.uniform(size=(200, 3)), rng.uniform(size=(60, 3))
    near = np.linalg.norm(truth[:, None] - points[None], axis=-1).min(axis=1)
    assert completeness(truth, points, 0.15) == pytest.approx(np.mean(near < 0.15))
    far_off = np.concatenate([points, points + 100])  # what is too much does not matter: share_beyond counts it
    assert completeness(truth, far_off, 0.15) == completeness(truth, points, 0.15)
    assert completeness(truth, np.zeros((0, 3)), 0.15) == 0


def test_projection_is_that_of_the_pinhole_with_centres_at_halves() -> None:
    points = np.array([[0.0, 0, 2], [0, 0, -2], [1.99, 0, 2], [2.01, 0, 2], [-2.0, -1.0, 2]])
    index, row, column, z = project(points, CAMERA)
    assert index.tolist() == [0, 2, 4]
    assert column.tolist() == [10, 19, 0]
    assert row.tolist() == [5, 5, 0]
    assert z.tolist() == [2, 2, 2]


def test_a_gaussian_floats_where_it_is_clearly_nearer_than_the_surface() -> None:
    surface = np.full((10, 20), 10.0)
    surface[:, 15:] = SKY
    surface[:, :5] = NAN
    at = {  # x at which a point of depth z falls into a column, and z
        "floats": (0.0, 7.9),
        "too near to the surface to tell": (0.0, 8.1),
        "behind": (0.0, 12.0),
        "in the sky": (6.0, 7.9),
        "where nothing is known": (-7.0, 7.9),
        "beside the picture": (20.0, 7.9),
        "behind the camera": (0.0, -1.0),
    }
    found = in_front(np.array([[x, 0.0, z] for x, z in at.values()]), CAMERA, surface)
    assert [name for name, floats in zip(at, found, strict=True) if floats] == ["floats"]


def test_what_surrounds_an_edge_does_not_float() -> None:
    """A post at depth 3 before a wall at 10: its Gaussians lie on it, though a pixel beside it shows the wall."""
    surface = np.full((10, 20), 10.0)
    surface[:, 10:12] = 3.0
    beside = [(column + 0.5 - 10) / 10 * 3.0 for column in (9, 12, 13, 14)]
    found = in_front(np.array([[x, 0.0, 3.0] for x in beside]), CAMERA, surface)
    assert found.tolist() == [False, False, False, True]


def test_floater_share_is_of_the_opacity_before_a_surface() -> None:
    alpha = np.array([[1.0, 0.5, 1.0]])
    front = np.array([[0.3, 0.0, 0.9]])
    assert floater_share(front, alpha, np.array([[4.0, 4.0, SKY]])) == pytest.approx(0.2)
    assert math.isnan(floater_share(front, alpha, np.full((1, 3), SKY)))


def test_points_are_held_against_the_depth_of_their_pixel() -> None:
    depth = np.full((10, 20), 4.0)
    depth[:, 10:] = 5.0
    depth[0] = NAN
    points = np.array([[-0.5, 0, 4.0], [0.5, 0, 4.0], [0.6, 0, 4.0], [0.1, -1.9, 4.0], [9.0, 0, 4.0]])
    assert point_depth_error(depth, CAMERA, points) == pytest.approx(0.25)  # of 0, 1/4 and 1/4
    assert point_depth_error(depth, CAMERA, points[:1]) == 0
    assert math.isnan(point_depth_error(depth, CAMERA, points[3:]))
