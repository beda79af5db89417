"""The facts of initial points and cameras, in a scene whose points and colours are known.

`tests/scene/tables.yaml` has the limits of the rules that judge them.
"""

import logging
import math
import statistics
from dataclasses import replace

import numpy as np
import pytest

from gsbench.normalization import Normalization
from gsbench.scene.types import Scene, View
from gsbench.train import start
from gsbench.train.start import _agreement, check_start
from tests.helpers import refusal
from tests.train.conftest import orbit_camera

WALL_Z = 4.0


def wall_color(points):
    """The colours [P, 3] of points on the wall z = 4, which has a smooth pattern."""
    waves = [np.sin(1.1 * points[:, 0] + k) + np.cos(0.9 * points[:, 1] - k) for k in range(3)]
    return (127 + 60 * np.stack(waves, axis=1)).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def scene():
    """Nine views of the wall: the ray of each pixel is intersected with it."""
    views = []
    for index, angle in enumerate(np.linspace(-0.6, 0.6, 9)):
        camera = orbit_camera(float(angle))
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        rays = np.stack(
            [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)],
            axis=-1,
        )
        rays = rays @ camera.rotation  # [H, W, 3] in world axes
        depth = (WALL_Z - camera.center[2]) / rays[..., 2]
        hits = (camera.center + depth[..., None] * rays).reshape(-1, 3)
        views.append(
            View(f"{index}.png", camera, wall_color(hits).reshape(camera.height, camera.width, 3))
        )
    return Scene("wall", tuple(views[1:]), tuple(views[:1]))


@pytest.fixture
def cloud():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1.2, 1.2, (600, 2)), np.full(600, WALL_Z)])
    return points, wall_color(points)


def test_a_correct_cloud_is_in_view_agrees_and_causes_no_warning(scene, cloud, caplog):
    facts, found = check_start(*cloud, scene)
    centers = [view.camera.center for view in scene.train]
    around, within = (
        statistics.median(
            math.dist(place, [*map(statistics.median, zip(*places, strict=True))])
            for place in places
        )
        for places in (centers, cloud[0].tolist())
    )
    assert facts.spread == pytest.approx(within / around)
    assert facts.seen == 1.0
    assert facts.color_agreement > 0.85
    assert (facts.identical, facts.far, found) == (0.0, 0, ())
    assert not caplog.records


def test_colour_agreement_is_relative_to_all_pairs_of_points(scene, cloud):
    points, colors = cloud
    swapped = colors[:, ::-1]
    facts, _ = check_start(points, swapped, scene)
    # The photographs show a point's own colour up to half a pixel, so these differences are close
    # to those that are measured.
    own = np.abs(swapped.astype(int) - colors).mean()
    pairs = np.abs(swapped[:, None].astype(int) - colors[None]).mean()
    assert facts.color_agreement == pytest.approx(1 - own / pairs, abs=0.05)


@pytest.mark.parametrize("level", [0, 1, 128, 255])
def test_a_cloud_of_one_colour_causes_a_warning(scene, cloud, level):
    points, colors = cloud
    plain = np.full_like(colors, level)
    plain[1:, 2] ^= 1  # the first point is named
    assert check_start(points, plain, scene, random_points=True)[1] == ()
    facts, (odd,) = check_start(points, plain, scene)
    assert facts.color_agreement is None
    assert f"the colour ({level}, {level}, {level})" in odd.line


@pytest.mark.parametrize(
    "change, doubt",
    [
        (lambda points: points - [1.4, 0.3, 0], "hardly agree"),
        (lambda points: points / 100 + [0, 0, 3.96], "half of the initial points lie within"),
        (lambda points: points * [8, 8, 1], "in view of two training views"),
        (
            lambda points: np.where(np.arange(600)[:, None] < 400, points[:1], points),
            "67% of the initial points share their place",
        ),
        (
            lambda points: np.where(np.arange(600)[:, None] < 2, points * 1e5, points),
            "2 initial points more than",
        ),
    ],
)
def test_a_wrong_cloud_causes_a_warning_and_a_random_one_none_about_colours_or_views(
    scene, cloud, caplog, change, doubt
):
    points, colors = cloud
    _, found = check_start(change(points), colors, scene)
    assert any(doubt in odd.line for odd in found), found
    assert [record.levelno for record in caplog.records] == [logging.WARNING] * len(found)
    _, at_random = check_start(change(points), colors, scene, random_points=True)
    assert not any("agree" in odd.line or "in view" in odd.line for odd in at_random)


def test_messages_have_the_scenes_own_coordinates(scene):
    points, colors = np.array([[0, 0, 4.0]] * 9), np.zeros((9, 3), dtype=np.uint8)
    with refusal(r"\(500000, 5400000, 308\)"):
        check_start(points, colors, scene, normalization=Normalization((5e5, 5.4e6, 300.0), 0.5))


def test_ignored_pixels_have_no_effect_on_the_agreement(scene, cloud):
    noise = np.random.default_rng(3).integers(0, 256, scene.train[0].image.shape, dtype=np.uint8)
    right = np.arange(noise.shape[1]) >= 20
    masked = [
        replace(
            view,
            image=np.where(right[None, :, None], view.image, noise),
            mask=np.broadcast_to(right, noise.shape[:2]),
        )
        for view in scene.train
    ]
    assert check_start(*cloud, Scene("masked", tuple(masked), ()))[0].color_agreement > 0.8


def test_black_pixels_count_in_the_agreement_and_points_that_no_photograph_shows_do_not():
    colors = np.array([[0, 0, 0]] * 10 + [[200, 100, 50]] * 10 + [[90, 90, 90]] * 5, dtype=np.uint8)
    shown = colors.astype(np.int16)
    shown[20:] = -1
    assert _agreement(colors, shown) == pytest.approx(1.0)
    assert _agreement(colors, np.full_like(shown, -1)) is None
    # Two points with each other's colour: all pairs differ by half as much on average.
    pair = np.array([[0, 0, 0], [255, 100, 50]], dtype=np.uint8)
    assert _agreement(pair, pair[::-1].astype(np.int16)) == pytest.approx(-1.0)
    assert _agreement(pair[:1], pair[1:].astype(np.int16)) is None


def test_most_cameras_may_stand_at_one_place(scene, cloud):
    """Lengths are then compared with the scene's extent."""
    first, last = scene.train[0], scene.train[-1]
    still = Scene("still", (first, first, first, last), ())
    facts, found = check_start(*cloud, still)
    within = np.median(np.linalg.norm(cloud[0] - np.median(cloud[0], axis=0), axis=1))
    assert facts.spread == pytest.approx(within / still.extent)
    assert found == ()


def test_of_a_large_cloud_evenly_spaced_points_are_measured(scene, cloud, monkeypatch):
    monkeypatch.setattr(start, "MAX_POINTS", 3)
    points, colors = cloud[0][:5].copy(), cloud[1][:5]
    points[[1, 3], 2] = -50.0  # behind the cameras
    assert check_start(points, colors, scene, random_points=True)[0].seen == 1.0
    points[[0, 2, 4], 2], points[[1, 3], 2] = -50.0, WALL_Z
    with refusal("no training view has one of the initial points in view"):
        check_start(points, colors, scene)


def test_a_view_shows_the_points_beyond_its_near_plane_from_its_first_to_its_last_pixel():
    camera = orbit_camera(0.0)
    image = np.arange(32 * 40 * 3, dtype=np.int64).reshape(32, 40, 3).astype(np.uint8)
    pixels = {(0.1, 0.1): (0, 0), (39.9, 0.1): (0, 39), (0.1, 31.9): (31, 0), (20.5, 8.5): (8, 20)}
    outside = [(-0.1, 5.0), (40.1, 5.0), (5.0, -0.1), (5.0, 32.1)]
    points = np.array(
        [[(u - 20) / 10, (v - 16) / 10, 4.0] for u, v in [*pixels, *outside]]
        + [[0.0, 0.0, 0.2], [0.0, 0.0, 0.201], [0.0, 0.0, -4.0]]
    )
    seen_by, shown = start._views_of(points, (View("a.png", camera, image),))
    assert seen_by.tolist() == [1, 1, 1, 1, 0, 0, 0, 0, 0, 1, 0]
    found = [shown[k].tolist() for k in range(4)]
    assert found == [image[row, column].tolist() for row, column in pixels.values()]
    assert (shown[seen_by == 0] == -1).all()
    # The colour is that of the nearer view, whichever comes first.
    back = orbit_camera(np.pi)  # at (0, 0, 8)
    views = (View("a.png", camera, image), View("b.png", back, np.full_like(image, 7)))
    for order in (views, views[::-1]):
        seen_by, shown = start._views_of(np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 5.0]]), order)
        assert seen_by.tolist() == [2, 2]
        assert shown.tolist() == [image[16, 20].tolist(), [7, 7, 7]]


def test_lengths_are_compared_with_the_median_distance_of_the_cameras(scene):
    """The cameras are at x = -10, 0 and 10, so the unit of distances is 10."""
    view = replace(scene.train[0], camera=orbit_camera(0.0))
    views = [
        replace(view, camera=replace(view.camera, translation=np.array([x, 0.0, 0.0])))
        for x in (-10.0, 0.0, 10.0)
    ]
    wide = Scene("wide", tuple(views), ())
    points = np.array([[0, 0, 4.0], [1, 0, 4], [0, 0, 99_000], [0, 0, 101_000]])
    colors = np.zeros((4, 3), np.uint8)
    assert check_start(points, colors, wide, random_points=True)[0].far == 1
    points[3, 2] = 1.1e8
    with refusal(r"initial point 3 of 4 is 1\.1e\+07 times as far"):
        check_start(points, colors, wide)
