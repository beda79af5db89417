"""A picture of a cloud and its cameras from above."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gsbench.init.colmap.alignment import Array
from gsbench.scene.colmap import points_of

SIDE_INCHES = 8.0
DPI = 120
MAX_POINTS = 200_000  # drawn; more would only hide each other
VISIBLE_SHARE = 0.98  # of the points; stray ones far off must not shrink the rest to a dot
FLATNESS = 0.5  # third over second singular value of the camera centres: below it they lie in a plane
ROUND = 0.05  # second over first: below it they lie on a line
VIEW_LINE = 0.06  # length of the lines of sight, as a share of the picture's side


def draw_cloud(model: pycolmap.Reconstruction, path: Path, title: str) -> None:
    """Draw a model from above into the PNG ``path``: points in their colours, cameras in red with lines of sight."""
    points, colors = points_of(model)
    if len(points) > MAX_POINTS:
        chosen = np.random.default_rng(0).permutation(len(points))[:MAX_POINTS]
        points, colors = points[chosen], colors[chosen]
    images = [image for _, image in sorted(model.images.items()) if image.has_pose]
    centers = np.array([image.projection_center() for image in images]).reshape(-1, 3)
    rotations = np.array([image.cam_from_world().rotation.matrix() for image in images]).reshape(-1, 3, 3)
    axes = view_from_above(centers, rotations, points)  # [3, 3]
    order = np.argsort(points @ axes[2], kind="stable")  # the highest are drawn last
    flat, flat_centers = points[order] @ axes[:2].T, centers @ axes[:2].T  # [P, 2], [V, 2]
    sights = rotations[:, 2] @ axes[:2].T  # [V, 2] viewing directions

    low, high = _limits(flat, flat_centers)
    figure = Figure(figsize=(SIDE_INCHES, SIDE_INCHES), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    plot = figure.add_subplot(facecolor="white")
    size = float(np.clip(20_000 / max(len(flat), 1), 0.5, 6.0))
    plot.scatter(flat[:, 0], flat[:, 1], s=size, c=colors[order] / 255.0, linewidths=0)
    ends = flat_centers + VIEW_LINE * (high - low).max() * sights
    plot.plot(*np.stack([flat_centers, ends], axis=2).transpose(1, 2, 0), color="#d62728", linewidth=0.8)
    plot.scatter(flat_centers[:, 0], flat_centers[:, 1], s=14, color="#d62728", zorder=3)
    plot.set_xlim(low[0], high[0])
    plot.set_ylim(low[1], high[1])
    plot.set_aspect("equal")
    plot.set_xlabel("model units")
    plot.set_title(title)
    figure.savefig(path, format="png", metadata={"Software": None})


def view_from_above(centers: Array, rotations: Array, points: Array) -> Array:
    """Unit vectors [3, 3] right, away and up, in world coordinates.

    Up is the normal of the plane that the camera centres [V, 3] lie in, else the mean of the images' upward directions;
    its sign is that of the images' upward direction or, for cameras that look down, puts cameras above ``points``.
    ``rotations`` [V, 3, 3] are world to camera.
    """
    image_up = -rotations[:, 1].mean(axis=0)  # [3]: y points down in the image
    _, spread, directions = np.linalg.svd(centers - centers.mean(axis=0), full_matrices=False)
    in_plane = len(centers) >= 3 and spread[1] > ROUND * spread[0] and spread[2] < FLATNESS * spread[1]
    up = directions[2] if in_plane else image_up
    towards = image_up
    if abs(up @ image_up) < 0.5 and len(points) > 0:
        towards = centers.mean(axis=0) - np.median(points, axis=0)
    up = up / np.linalg.norm(up) * (1.0 if up @ towards >= 0 else -1.0)
    right = rotations[0, 0] - (rotations[0, 0] @ up) * up  # the first camera's right is the picture's right
    if np.linalg.norm(right) < 1e-6:
        right = np.eye(3)[np.argmin(np.abs(up))] - up[np.argmin(np.abs(up))] * up
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])


def _limits(flat: Array, centers: Array) -> tuple[Array, Array]:
    """Lower left and upper right corner: all cameras, and most of the points."""
    tail = (1 - VISIBLE_SHARE) / 2
    corners = [centers] if len(flat) == 0 else [centers, np.quantile(flat, [tail, 1 - tail], axis=0)]
    together = np.concatenate(corners)
    low, high = together.min(axis=0), together.max(axis=0)
    margin = 0.05 * max(float((high - low).max()), 1e-9)
    return low - margin, high + margin
