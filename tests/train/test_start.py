"""The checks of initial points and cameras, in a scene whose points and colours are known."""

from __future__ import annotations

import contextlib
import logging
from dataclasses import replace

import numpy as np
import pytest

from gsbench.errors import InputError
from gsbench.normalization import Normalization
from gsbench.runs.trial_record import InitialCloud
from gsbench.scene.types import Scene, View
from gsbench.train.start import _agreement, check_start, odd_lenses
from tests.train.conftest import orbit_camera

WALL_Z = 4.0


def wall_color(points: np.ndarray) -> np.ndarray:
    """The colours [P, 3] of points on the wall z = 4, which has a smooth pattern."""
    waves = [np.sin(1.1 * points[:, 0] + k) + np.cos(0.9 * points[:, 1] - k) for k in range(3)]
    return (127 + 60 * np.stack(waves, axis=1)).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def scene() -> Scene:
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
def cloud() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1.2, 1.2, (600, 2)), np.full(600, WALL_Z)])
    return points, wall_color(points)


def test_a_correct_cloud_is_in_view_agrees_and_causes_no_warning(
    scene: Scene, cloud: tuple[np.ndarray, np.ndarray], caplog: pytest.LogCaptureFixture
) -> None:
    facts = check_start(*cloud, scene)
    assert facts.seen == 1.0
    assert facts.color_agreement > 0.85
    assert (facts.identical, facts.far, facts.warnings) == (0.0, 0, [])
    assert not caplog.records


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda camera: {"fx": 0.8, "fy": 0.8}, "a focal length of 0.8 px for a width of"),
        (lambda camera: {"fx": 300 * camera.width, "fy": 300 * camera.width}, "a focal length of"),
        (lambda camera: {"fy": 2 * camera.fx}, "pixels are square"),
        (lambda camera: {"fy": 0.7 * camera.fx}, "pixels are square"),
        (lambda camera: {"cx": 0.5, "cy": 0.5}, "its principal point at (0.5, 0.5)"),
        (lambda camera: {"cy": -3.0}, "its principal point"),
        (lambda camera: {"cx": 1.2 * camera.cx, "fy": 1.1 * camera.fx}, ""),
    ],
)
def test_intrinsics_that_no_lens_has_cause_one_warning(
    scene: Scene,
    cloud: tuple[np.ndarray, np.ndarray],
    change,
    said: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    train = tuple(
        replace(view, camera=replace(view.camera, **change(view.camera))) for view in scene.train
    )
    changed = replace(scene, train=train)
    lines = odd_lenses(changed)
    assert len(lines) == bool(said)
    for line in lines:
        assert line.startswith("the camera of 1.png, 2.png, 3.png and 5 more has ")
        assert said in line
    caplog.clear()
    with contextlib.suppress(InputError):  # a lens may also leave no point in view
        check_start(*cloud, changed, random_points=True)
    assert all(line in caplog.text for line in lines)


@pytest.mark.parametrize("level", [0, 1, 128, 255])
def test_a_cloud_of_one_colour_causes_a_warning(
    scene: Scene, cloud: tuple[np.ndarray, np.ndarray], level: int
) -> None:
    points, colors = cloud
    plain = np.full_like(colors, level)
    assert check_start(points, plain, scene, random_points=True).warnings == []
    facts = check_start(points, plain, scene)
    assert facts.color_agreement is None
    (line,) = facts.warnings
    assert f"the colour ({level}, {level}, {level})" in line


def seen_by_brute_force(points: np.ndarray, scene: Scene) -> float:
    """The share of points that two views see, point by point and view by view."""
    shares = []
    for point in points:
        seen = 0
        for view in scene.train:
            x, y, z = view.camera.rotation @ point + view.camera.translation
            if z > 0.2:
                column = view.camera.fx * x / z + view.camera.cx
                row = view.camera.fy * y / z + view.camera.cy
                seen += 0 <= column < view.camera.width and 0 <= row < view.camera.height
        shares.append(seen >= 2)
    return float(np.mean(shares))


def test_the_share_in_view_equals_that_of_a_loop_over_points_and_views(scene: Scene) -> None:
    points = np.random.default_rng(1).uniform(-4, 8, (300, 3))
    colors = np.random.default_rng(2).integers(0, 256, points.shape, dtype=np.uint8)
    assert check_start(points, colors, scene, random_points=True).seen == seen_by_brute_force(
        points, scene
    )


@pytest.mark.parametrize(
    ("change", "doubt"),
    [
        (lambda points: points - [1.4, 0.3, 0], "hardly agree"),
        (lambda points: (points - [0, 0, 4]) * [-1, -1, 1] + [0, 0, 4], "hardly agree"),
        (lambda points: points / 100 + [0, 0, 3.96], "half of the initial points lie within"),
        (lambda points: points / 100 + [0, 0, 3.96], "hardly agree"),
        (lambda points: points * [8, 8, 1], "in view of two training views"),
        (
            lambda points: np.where(np.arange(600)[:, None] < 400, points[:1], points),
            "share their place",
        ),
        (
            lambda points: np.where(np.arange(600)[:, None] < 2, points * 1e5, points),
            "2 initial points more than",
        ),
    ],
)
def test_a_wrong_cloud_causes_a_warning_and_a_random_one_none_about_colours_or_views(
    scene: Scene,
    cloud: tuple[np.ndarray, np.ndarray],
    caplog: pytest.LogCaptureFixture,
    change,
    doubt: str,
) -> None:
    points, colors = cloud
    facts = check_start(change(points), colors, scene)
    assert any(doubt in line for line in facts.warnings), facts
    assert [record.levelno for record in caplog.records] == [logging.WARNING] * len(facts.warnings)
    at_random = check_start(change(points), colors, scene, random_points=True)
    assert not any("agree" in line or "in view" in line for line in at_random.warnings)


def test_colour_agreement_is_relative_to_all_pairs_of_points(
    scene: Scene, cloud: tuple[np.ndarray, np.ndarray]
) -> None:
    points, colors = cloud
    swapped = colors[:, ::-1]
    facts, right = check_start(points, swapped, scene), check_start(points, colors, scene)
    # The photographs show a point's own colour up to half a pixel, so these differences are close
    # to those that are measured.
    own = np.abs(swapped.astype(int) - colors).mean()
    pairs = np.abs(swapped[:, None].astype(int) - colors[None]).mean()
    assert facts.color_agreement == pytest.approx(1 - own / pairs, abs=0.05)
    assert facts.color_agreement < right.color_agreement


@pytest.mark.parametrize(
    ("points", "error"),
    [
        (np.array([[0, 0, 4.0]] * 9), r"all at one place, \(0, 0, 4\)"),
        (
            np.array([[0, 0, 4.0], [1, 1, 4], [0, 1, 4], [1e30, 1e30, 1e30]]),
            r"initial point 3 of 4 .* \(1e\+30",
        ),
        (
            np.array([[k, 0, 1000.0] for k in range(9)]) * [1, 1, -1],
            "other coordinates than the cameras",
        ),
    ],
)
def test_a_start_from_which_nothing_can_be_learnt_is_refused(
    scene: Scene, points: np.ndarray, error: str
) -> None:
    colors = np.zeros(points.shape, dtype=np.uint8)
    with pytest.raises(InputError, match=error):
        check_start(points, colors, scene)


def test_messages_have_the_scenes_own_coordinates(scene: Scene) -> None:
    points, colors = np.array([[0, 0, 4.0]] * 9), np.zeros((9, 3), dtype=np.uint8)
    with pytest.raises(InputError, match=r"\(500000, 5400000, 308\)"):
        check_start(points, colors, scene, normalization=Normalization((5e5, 5.4e6, 300.0), 0.5))


def test_cameras_at_one_place_are_refused_and_a_far_camera_causes_a_warning(
    scene: Scene, cloud: tuple[np.ndarray, np.ndarray]
) -> None:
    first = scene.train[0]
    with pytest.raises(InputError, match="all training cameras stand at one place"):
        check_start(*cloud, Scene("still", (first, first, first), ()))
    far_off = first.camera.translation + np.array([3e3, 0, 0])
    away = replace(first, camera=replace(first.camera, translation=far_off))
    facts: InitialCloud = check_start(*cloud, Scene("wall", (away, *scene.train[1:]), ()))
    (line,) = facts.warnings  # other facts do not depend on the far camera
    assert line.startswith("the camera of 1.png is ")
    assert "sets the scene extent to" in line


def test_ignored_pixels_have_no_effect_on_the_agreement(
    scene: Scene, cloud: tuple[np.ndarray, np.ndarray]
) -> None:
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
    facts = check_start(*cloud, Scene("masked", tuple(masked), ()))
    assert facts.color_agreement > 0.8


def test_black_pixels_count_in_the_agreement_and_points_that_no_photograph_shows_do_not() -> None:
    colors = np.array([[0, 0, 0]] * 10 + [[200, 100, 50]] * 10 + [[90, 90, 90]] * 5, dtype=np.uint8)
    shown = colors.astype(np.int16)
    shown[20:] = -1
    assert _agreement(colors, shown) == pytest.approx(1.0)
    assert _agreement(colors, np.full_like(shown, -1)) is None
