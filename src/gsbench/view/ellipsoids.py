"""Solid ellipsoids and points, drawn on the CPU into a picture with a depth buffer."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbench.scene.camera import Camera
from gsbench.system.jit import inlined, kernel

NEAR = 0.05  # world units: surfaces nearer than this are not drawn
AMBIENT = 0.35  # brightness of a surface seen edge-on; face-on it is 1
POINT_SIZE = 2  # px

Floats = NDArray[np.float64]


class Canvas:
    """A picture [H, W, 3] (floating point, 0 to 255) and the depth z of what was drawn so far, [H, W]."""

    def __init__(self, picture: NDArray[np.uint8], camera: Camera, brightness: float = 1.0) -> None:
        self.camera = camera
        self.picture = picture.astype(np.float64) * brightness
        self.depth = np.full(picture.shape[:2], np.inf)

    def points(self, points: Floats, colors: NDArray[np.uint8]) -> None:
        """Draw ``points`` [P, 3] (world) with ``colors`` [P, 3] as squares of ``POINT_SIZE`` px, nearest in front."""
        camera = self.camera
        seen = points @ camera.rotation.T + camera.translation  # [P, 3]
        order = np.argsort(-seen[:, 2])
        order = order[seen[order, 2] > NEAR]
        x, y, z = seen[order].T
        columns = np.floor(camera.fx * x / z + camera.cx).astype(np.int64)
        rows = np.floor(camera.fy * y / z + camera.cy).astype(np.int64)
        # Far to near, so that of several points in one pixel the nearest is written last.
        for shift_row in range(POINT_SIZE):
            for shift_column in range(POINT_SIZE):
                row, column = rows - shift_row, columns - shift_column
                inside = (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
                inside[inside] &= z[inside] < self.depth[row[inside], column[inside]] + 1e-9
                self.picture[row[inside], column[inside]] = colors[order[inside]]
                self.depth[row[inside], column[inside]] = z[inside]

    def ellipsoids(self, centers: Floats, rotations: Floats, semi_axes: Floats, colors: NDArray[np.uint8]) -> None:
        """Draw ellipsoids at ``centers`` [E, 3] (world); the columns of ``rotations`` [E, 3, 3] are their axes."""
        camera = self.camera
        seen = centers @ camera.rotation.T + camera.translation  # [E, 3]
        axes = camera.rotation @ rotations  # [E, 3, 3] in the camera
        to_sphere = np.swapaxes(axes / semi_axes[:, None, :], 1, 2)  # [E, 3, 3] the ellipsoid becomes the unit sphere
        _draw_ellipsoids(
            np.ascontiguousarray(seen),
            np.ascontiguousarray(to_sphere),
            np.ascontiguousarray(semi_axes.max(axis=1)),
            np.ascontiguousarray(colors),
            (camera.fx, camera.fy, camera.cx, camera.cy),
            self.picture,
            self.depth,
        )

    def image(self) -> NDArray[np.uint8]:
        return np.clip(np.rint(self.picture), 0, 255).astype(np.uint8)


@inlined
def _range(focal: float, principal: float, x: float, z: float, radius: float, size: int) -> Any:
    """The pixels [first, end) along one axis that a sphere at (x, z) may cover."""
    if z - radius <= NEAR:
        return 0, size
    low = min((x - radius) / (z - radius), (x - radius) / (z + radius))
    high = max((x + radius) / (z - radius), (x + radius) / (z + radius))
    first = min(max(focal * low + principal - 0.5, 0.0), float(size))
    last = min(max(focal * high + principal + 0.5, 0.0), float(size))
    return int(first), int(last)


@kernel
def _draw_ellipsoids(
    centers: Any, to_sphere: Any, radii: Any, colors: Any, intrinsics: Any, picture: Any, depth: Any
) -> None:
    """Cast a ray d = (x, y, 1) through each pixel centre: the nearer root t of |M (t d - c)| = 1 is the surface's z."""
    fx, fy, cx, cy = intrinsics
    height, width = depth.shape
    for e in range(len(centers)):
        if centers[e, 2] + radii[e] <= NEAR:
            continue
        first_column, end_column = _range(fx, cx, centers[e, 0], centers[e, 2], radii[e], width)
        first_row, end_row = _range(fy, cy, centers[e, 1], centers[e, 2], radii[e], height)
        m, c = to_sphere[e], centers[e]
        px = m[0, 0] * c[0] + m[0, 1] * c[1] + m[0, 2] * c[2]
        py = m[1, 0] * c[0] + m[1, 1] * c[1] + m[1, 2] * c[2]
        pz = m[2, 0] * c[0] + m[2, 1] * c[1] + m[2, 2] * c[2]
        rest = px * px + py * py + pz * pz - 1.0
        for row in range(first_row, end_row):
            y = (row + 0.5 - cy) / fy
            for column in range(first_column, end_column):
                x = (column + 0.5 - cx) / fx
                qx = m[0, 0] * x + m[0, 1] * y + m[0, 2]
                qy = m[1, 0] * x + m[1, 1] * y + m[1, 2]
                qz = m[2, 0] * x + m[2, 1] * y + m[2, 2]
                a = qx * qx + qy * qy + qz * qz
                b = qx * px + qy * py + qz * pz
                inside = b * b - a * rest
                if inside <= 0.0:
                    continue
                z = (b - math.sqrt(inside)) / a
                if z <= NEAR or z >= depth[row, column]:
                    continue
                ux, uy, uz = z * qx - px, z * qy - py, z * qz - pz  # on the unit sphere
                nx = m[0, 0] * ux + m[1, 0] * uy + m[2, 0] * uz
                ny = m[0, 1] * ux + m[1, 1] * uy + m[2, 1] * uz
                nz = m[0, 2] * ux + m[1, 2] * uy + m[2, 2] * uz
                facing = -(nx * x + ny * y + nz) / math.sqrt((nx * nx + ny * ny + nz * nz) * (x * x + y * y + 1.0))
                light = AMBIENT + (1.0 - AMBIENT) * max(facing, 0.0)
                depth[row, column] = z
                for channel in range(3):
                    picture[row, column, channel] = light * colors[e, channel]
