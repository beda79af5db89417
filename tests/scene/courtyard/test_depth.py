"""The courtyard's exact depth against its distance function, which is computed in another way."""

from __future__ import annotations

import numpy as np
import pytest

from gsbench.scene.courtyard.render import courtyard_cameras, courtyard_depth, surface_distance


@pytest.mark.parametrize("seed", [0, 3])
def test_depths_end_at_the_first_surface(seed: int) -> None:
    camera = list(courtyard_cameras(12, 64, 48).values())[3]
    depth = courtyard_depth(camera, seed)
    solid = np.isfinite(depth)
    assert 0.5 < solid.mean() < 1.0  # there is some sky
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], -1)
    directions = (rays @ camera.rotation)[solid]  # [P, 3] of z 1
    at = camera.center + directions * depth[solid][:, None]
    assert surface_distance(at, seed).max() < 1e-6  # it ends on a surface
    lengths = np.linalg.norm(directions, axis=1) * depth[solid]
    travelled = np.zeros(len(lengths))  # sphere tracing: steps of the distance to the nearest surface cross none
    units = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    for _ in range(400):
        free = surface_distance(camera.center + units * travelled[:, None], seed)
        travelled += np.where(free > 1e-9, free, 0.0)
    assert (travelled < lengths + 1e-6).all()  # so no depth is too small
    assert np.quantile(lengths - travelled, 0.95) < 1e-3  # nor too large; a grazing ray creeps for longer than this


def test_the_sky_is_infinitely_far() -> None:
    camera = list(courtyard_cameras(12, 64, 48).values())[3]
    assert np.isinf(courtyard_depth(camera)[0]).any()
