"""The exact depth of the procedural courtyard: it is made of solids, so where a ray ends is known."""

from __future__ import annotations

from math import inf, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbench.scene.camera import Camera
from gsbench.scene.courtyard.kernels import SKY, cast, to_local
from gsbench.scene.courtyard.layout import build_layout
from gsbench.system.jit import kernel


def courtyard_depth(camera: Camera, seed: int = 0) -> NDArray[np.float64]:
    """The depth along z, in m, that the centre of each pixel sees, [H, W]; infinite in the sky.

    ``camera`` is in the courtyard's own coordinates, ``seed`` that of its pictures (``scene.seed``).
    """
    layout = build_layout(seed)
    depth = np.empty((camera.height, camera.width))
    _depths(
        layout.kind, layout.center, layout.rotation, layout.size,
        layout.group_start, layout.group_low, layout.group_high,
        np.ascontiguousarray(camera.rotation), np.ascontiguousarray(camera.center),
        (camera.fx, camera.fy, camera.cx, camera.cy), depth,
    )  # fmt: skip
    return depth


@kernel
def _depths(
    kind: Any,
    center: Any,
    rotation: Any,
    size: Any,
    start: Any,
    low: Any,
    high: Any,
    camera_rotation: Any,
    origin: Any,
    intrinsics: Any,
    depth: Any,
) -> None:
    fx, fy, cx, cy = intrinsics
    ox, oy, oz = origin
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            across, down = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
            scale = 1.0 / sqrt(across * across + down * down + 1.0)
            dx, dy, dz = to_local(camera_rotation, across * scale, down * scale, scale)
            distance, hit = cast(kind, center, rotation, size, start, low, high, ox, oy, oz, dx, dy, dz, False)
            depth[row, column] = inf if hit == SKY else distance * scale
