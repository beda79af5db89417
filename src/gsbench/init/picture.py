"""A picture of a model from above: points in their colours, cameras in red."""

from __future__ import annotations

from math import floor, log10
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image, ImageDraw

from gsbench.scene.colmap import camera_centers, model_points
from gsbench.scene.types import Array

SIDE, MARGIN = 960, 60  # px
MAX_POINTS = 200_000  # drawn; more would only cover each other
# share of the points in view; distant outliers must not shrink the rest to a dot
VISIBLE_SHARE = 0.98
# third over second singular value of the camera centres: below it they lie in a plane
PLANE_RATIO = 0.5
LINE_RATIO = 0.05  # second over first: below it they lie on a line
VIEW_LINE = 0.06  # length of the lines of sight, as a share of the picture's side
CAMERA_COLOR = (214, 39, 40)


def draw_cloud(model: pycolmap.Reconstruction, path: Path, title: str) -> None:
    """Draw a model from above into a PNG: points, and cameras with lines of sight in red."""
    points, colors = model_points(model)
    if len(points) > MAX_POINTS:
        chosen = np.random.default_rng(0).permutation(len(points))[:MAX_POINTS]
        points, colors = points[chosen], colors[chosen]
    images = [image for _, image in sorted(model.images.items()) if image.has_pose]
    centers = camera_centers(model)
    poses = [image.cam_from_world() for image in images]
    rotations = np.array([pose.rotation.matrix() for pose in poses]).reshape(-1, 3, 3)
    axes = view_from_above(centers, rotations, points)  # [3, 3]
    # the highest points are drawn last, over lower ones
    order = np.argsort(points @ axes[2], kind="stable")
    flat, flat_centers = points[order] @ axes[:2].T, centers @ axes[:2].T  # [P, 2], [V, 2]
    low, high = _limits(flat, flat_centers)
    scale = (SIDE - 2 * MARGIN) / (high - low).max()  # px for a unit of the model

    def pixels(positions: Array) -> Array:
        return SIDE / 2 + (positions - (low + high) / 2) * scale * (1, -1)

    canvas = np.full((SIDE, SIDE, 3), 255, dtype=np.uint8)
    columns, rows = np.floor(pixels(flat)).astype(np.int64).T  # [P] each
    size = 1 if len(flat) > 50_000 else 2 if len(flat) > 5_000 else 3  # px of a point
    for dx, dy in np.ndindex(size, size):
        x, y = columns + dx, rows + dy
        inside = (x >= 0) & (x < SIDE) & (y >= 0) & (y < SIDE)
        canvas[y[inside], x[inside]] = colors[order][inside]
    picture = Image.fromarray(canvas)
    draw = ImageDraw.Draw(picture)
    sights = flat_centers + VIEW_LINE * (high - low).max() * rotations[:, 2] @ axes[:2].T  # [V, 2]
    for (x, y), (to_x, to_y) in zip(pixels(flat_centers), pixels(sights), strict=True):
        draw.line((x, y, to_x, to_y), fill=CAMERA_COLOR, width=2)
        draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill=CAMERA_COLOR)
    draw.text((MARGIN, 16), title, fill="black", font_size=18)
    bar = 10.0 ** floor(log10((high - low).max() / 2))  # model units
    draw.line((MARGIN, SIDE - 24, MARGIN + bar * scale, SIDE - 24), fill="black", width=3)
    draw.text((MARGIN, SIDE - 48), f"{bar:g} model units", fill="black", font_size=16)
    picture.save(path, format="PNG")


def view_from_above(centers: Array, rotations: Array, points: Array) -> Array:
    """Unit vectors [3, 3] right, away and up, in world coordinates.

    Up is the normal of the plane of the camera centres [V, 3] or, if they lie in no plane, the mean
    of the images' upward directions. The normal's sign agrees with the images' upward directions;
    for cameras that look down, it puts the cameras above ``points``. ``rotations`` [V, 3, 3] are
    world to camera.
    """
    image_up = -rotations[:, 1].mean(axis=0)  # [3]: y points down in the image
    _, spread, directions = np.linalg.svd(centers - centers.mean(axis=0), full_matrices=False)
    in_line = len(centers) < 3 or spread[1] <= LINE_RATIO * spread[0]
    in_plane = not in_line and spread[2] < PLANE_RATIO * spread[1]
    up = directions[2] if in_plane else image_up
    towards = image_up
    if abs(up @ image_up) < 0.5 and len(points) > 0:
        towards = centers.mean(axis=0) - np.median(points, axis=0)
    up = up / np.linalg.norm(up) * (1.0 if up @ towards >= 0 else -1.0)
    # the first camera's right is the picture's right
    right = rotations[0, 0] - (rotations[0, 0] @ up) * up
    if np.linalg.norm(right) < 1e-6:
        across = np.argmin(np.abs(up))
        right = np.eye(3)[across] - up[across] * up
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def _limits(flat: Array, centers: Array) -> tuple[Array, Array]:
    """The lower left and upper right corners of an area with all cameras and most points."""
    tail = (1 - VISIBLE_SHARE) / 2
    corners = centers
    if len(flat):
        corners = np.concatenate([centers, np.quantile(flat, [tail, 1 - tail], axis=0)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.05 * max(float((high - low).max()), 1e-9)
    return low - margin, high + margin
