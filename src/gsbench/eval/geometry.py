"""Errors of a model's geometry: its depths, its surfaces, and the Gaussians that float in front of them.

Depths [H, W] are along z, in world units: not a number where a render shows no surface, infinite where the truth has
none. Shares and relative errors are plain numbers (0.02 is 2 %), and not a number where there is nothing to measure.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter
from scipy.spatial import cKDTree

from gsbench.scene.camera import Camera

FRONT = 0.8  # a Gaussian nearer than this share of the surface's depth is in front of it
EDGE = 5  # px a side: the nearest surface within counts, so that what surrounds an edge does not float

Array = NDArray[np.float64]


def depth_error(depth: Array, truth: Array) -> float:
    """The mean of ``|depth - truth| / truth`` over the pixels [H, W] where both show a surface."""
    both = np.isfinite(depth) & np.isfinite(truth)
    return _mean(np.abs(depth[both] - truth[both]) / truth[both])


def share_beyond(distances: Array, tolerance: float) -> float:
    """The share of points whose distances [P] to the true surfaces exceed ``tolerance``: points off surfaces."""
    return _mean(distances > tolerance)


def completeness(true_points: Array, points: Array, tolerance: float) -> float:
    """The share of the true surface points [P, 3] that have one of ``points`` [Q, 3] within ``tolerance``."""
    if not len(points):
        return 0.0 if len(true_points) else np.nan
    near, _ = cKDTree(points).query(true_points, distance_upper_bound=tolerance)
    return _mean(np.isfinite(near))


def point_depth_error(depth: Array, camera: Camera, points: Array) -> float:
    """The median of ``|depth - z| / z`` over the points [P, 3] (world units) that fall on a surface of the render.

    The median, since points of structure from motion have outliers.
    """
    _, row, column, z = project(points, camera)
    rendered = depth[row, column]  # [P']
    seen = np.isfinite(rendered)
    return float(np.median(np.abs(rendered[seen] - z[seen]) / z[seen])) if seen.any() else np.nan


def in_front(centers: Array, camera: Camera, surface: Array) -> NDArray[np.bool_]:
    """The mask [N] of Gaussians whose ``centers`` [N, 3] lie clearly in front of the ``surface`` [H, W] that they hide.

    Judged by their centres: nearer than 0.8 of the smallest depth within two pixels. Those that lie outside the
    picture, or where no surface is known, are not.
    """
    nearest = minimum_filter(np.where(np.isnan(surface), np.inf, surface), EDGE, mode="nearest")  # [H, W]
    index, row, column, z = project(centers, camera)
    limit = nearest[row, column]
    found = np.zeros(len(centers), dtype=np.bool_)
    found[index[np.isfinite(limit) & (z < FRONT * limit)]] = True
    return found


def floater_share(front: Array, alpha: Array, surface: Array) -> float:
    """The share of the opacity ``alpha`` [H, W] that lies in front, ``front`` [H, W], where there is a surface."""
    known = np.isfinite(surface)
    total = float(alpha[known].sum())
    return float(front[known].sum()) / total if total > 0 else np.nan


def project(points: Array, camera: Camera) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Array]:
    """Project the points [P, 3] before the camera and inside its picture: (index, row, column, depth), [P'] each."""
    in_view = points @ camera.rotation.T + camera.translation  # [P, 3]
    index = np.flatnonzero(in_view[:, 2] > 0)
    x, y, z = in_view[index].T
    column = np.floor(camera.fx * x / z + camera.cx)
    row = np.floor(camera.fy * y / z + camera.cy)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return index[inside], row[inside].astype(np.int64), column[inside].astype(np.int64), z[inside]


def band_errors(image: Array, truth: Array, camera: Camera, points: Array, counts: NDArray[np.bool_]) -> list[float]:
    """The mean absolute error of the nearest, the middle and the farthest third of a view's pixels, in their units.

    A pixel of ``image`` [H, W, 3] is as far away as that of ``points`` [P, 3] which is seen nearest to it in the
    picture, so that all models of one initial cloud are judged on the same pixels. What ``counts`` [H, W] leaves out
    belongs to no third. Not a number where the view shows none of the points.
    """
    _, row, column, z = project(points, camera)
    if not len(z):
        return [np.nan] * 3
    pixels = np.argwhere(counts)  # [Q, 2]
    depths = z[cKDTree(np.stack([row, column], axis=1)).query(pixels)[1]]  # [Q]
    errors = np.abs(image - truth).mean(axis=-1)[counts][np.argsort(depths, kind="stable")]
    return [_mean(third) for third in np.array_split(errors, 3)]


def _mean(values: NDArray[np.float64] | NDArray[np.bool_]) -> float:
    return float(values.mean()) if values.size else np.nan
