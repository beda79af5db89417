"""Regions of the test views, in which metrics are measured apart (``eval.regions``).

All arms of a scene have the same regions: they come from the scene's own model, a sensor or masks,
never from what an arm trained.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gsbench.eval.options import DISTANCES
from gsbench.scene.types import Camera

LEAST_SHARE = 0.01  # of a view's pixels; metrics of fewer say little, and are left out

Depth = NDArray[np.float32]
Regions = Mapping[str, NDArray[np.bool_]]  # masks [H, W] by region


def depths_of_points(points: NDArray[np.float64], camera: Camera) -> Depth:
    """The view z [H, W] of the point [P, 3] that is projected nearest to each pixel.

    It is 0 everywhere if the view shows no point.
    """
    in_camera = points @ camera.rotation.T + camera.translation  # [P, 3]
    in_camera = in_camera[in_camera[:, 2] > 0]
    x, y, z = in_camera.T
    places = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
    seen = ((places >= 0) & (places < (camera.width, camera.height))).all(axis=1)
    if not seen.any():
        return np.zeros((camera.height, camera.width), np.float32)
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    _, nearest = cKDTree(places[seen]).query(np.stack([columns, rows], axis=-1))  # [H, W]
    return z[seen].astype(np.float32)[nearest]


def regions_by_distance(depths: Mapping[str, Depth]) -> dict[str, Regions]:
    """The terciles of all known depths, by test view: near, middle and far.

    ``depths`` [H, W] are 0 where they are not known; these pixels are in no region.
    """
    known = np.concatenate([depth[depth > 0] for depth in depths.values()])
    if not len(known):
        return {name: {} for name in depths}
    limits = np.quantile(known, [1 / 3, 2 / 3])
    parts = {name: np.digitize(depth, limits, right=True) for name, depth in depths.items()}
    return {
        name: {
            region: (depths[name] > 0) & (part == number) for number, region in enumerate(DISTANCES)
        }
        for name, part in parts.items()
    }
