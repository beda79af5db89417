"""Solid ellipsoids and points against projective geometry."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gsbench.scene.camera import Camera
from gsbench.view.picture import Canvas

WIDTH, HEIGHT = 90, 60


def make_camera(seed: int = 0) -> Camera:
    rotation = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, 0.2, 3)).as_matrix()
    return Camera(WIDTH, HEIGHT, 80.0, 76.0, 47.0, 28.0, rotation, np.array([0.1, -0.2, 5.0]))


def blank(camera: Camera) -> Canvas:
    return Canvas(np.zeros((camera.height, camera.width, 3), np.uint8), camera)


def pixel_centers() -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.stack([columns, rows, np.ones_like(rows)], -1)  # [H, W, 3]


def test_outline_is_the_image_of_the_dual_quadric() -> None:
    """The outline of a quadric Q is the conic with C* = P Q* P^T (Hartley and Zisserman, eq. 8.5)."""
    rng = np.random.default_rng(1)
    camera = make_camera()
    intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    projection = intrinsics @ np.column_stack([camera.rotation, camera.translation])  # [3, 4]
    for _ in range(8):
        center, turn = rng.uniform(-1.5, 1.5, 3), Rotation.random(random_state=rng).as_matrix()
        axes = rng.uniform(0.05, 0.9, 3)
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = turn * axes, center
        dual_conic = projection @ place @ np.diag([1.0, 1, 1, -1]) @ place.T @ projection.T
        conic = np.linalg.inv(dual_conic)
        pixels = pixel_centers()
        value = np.einsum("hwi,ij,hwj->hw", pixels, conic, pixels)
        middle = projection @ np.append(center, 1)
        middle /= middle[2]
        expected = value * (middle @ conic @ middle) > 0  # the same side as the centre
        canvas = blank(camera)
        canvas.ellipsoids(center[None], turn[None], axes[None], np.full((1, 3), 200, np.uint8))
        assert (np.isfinite(canvas.depth) == expected).all()
        assert expected.any()


def test_depth_lies_on_the_near_side_and_the_nearer_ellipsoid_wins() -> None:
    camera = make_camera(2)
    centers = np.array([[0.0, 0.0, 0.0], [0.8, 0.4, 0.6]])
    turns = Rotation.random(2, random_state=3).as_matrix()
    axes = np.array([[0.9, 0.5, 0.7], [0.4, 0.3, 0.6]])
    canvas = blank(camera)
    canvas.ellipsoids(centers, turns, axes, np.array([[255, 0, 0], [0, 0, 255]], np.uint8))
    seen = np.isfinite(canvas.depth)
    rays = pixel_centers() @ np.linalg.inv([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]).T
    # In front of the surface, every sample along the ray lies outside both; at it, on the one whose colour is shown.
    for share in (0.5, 0.9, 0.999, 1.0):
        world = (rays * np.where(seen, canvas.depth, 0)[..., None] * share - camera.translation) @ camera.rotation
        local = np.einsum("hwei,eij->hwej", world[:, :, None] - centers, turns) / axes
        value = (local**2).sum(-1)[seen]  # [pixels, 2]
        if share < 1:
            assert (value > 1).all()
        else:
            shown = np.where(canvas.picture[seen][:, 0] > 0, 0, 1)
            np.testing.assert_allclose(value[np.arange(len(value)), shown], 1, atol=1e-9)
            assert 0 < shown.mean() < 1


def test_camera_inside_an_ellipsoid_and_one_behind_it_draw_nothing() -> None:
    camera = make_camera()
    canvas = blank(camera)
    centers = np.stack([camera.center, camera.center - 3 * camera.rotation[2]])
    canvas.ellipsoids(centers, np.stack([np.eye(3)] * 2), np.full((2, 3), 0.5), np.full((2, 3), 9, np.uint8))
    assert not np.isfinite(canvas.depth).any()


def test_points_land_where_the_camera_projects_them_nearest_in_front() -> None:
    camera = make_camera(4)
    target = np.array([30.5, 20.5])  # px
    ray = np.array([(target[0] - camera.cx) / camera.fx, (target[1] - camera.cy) / camera.fy, 1.0])
    points = np.stack([(ray * z - camera.translation) @ camera.rotation for z in (4.0, 3.0, 6.0, -2.0)])
    colors = np.array([[10, 0, 0], [20, 0, 0], [30, 0, 0], [40, 0, 0]], np.uint8)
    canvas = blank(camera)
    canvas.points(points, colors)
    rows, columns = np.nonzero(canvas.picture[..., 0])
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (19, 20, 29, 30)
    assert set(canvas.picture[rows, columns, 0]) == {20.0}
