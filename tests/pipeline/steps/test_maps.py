"""Maps of a view against a scene whose geometry is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from gsbench.gaussians.model import Gaussians
from gsbench.pipeline.steps.pictures import unproject, view_maps
from gsbench.raster.reference import ReferenceRasterizer
from tests.train.conftest import orbit_camera


@pytest.mark.parametrize("z", [3.0, 0.6])
def test_maps_of_a_flat_wall(z: float) -> None:
    """Opaque discs on a plane in front of a camera at the origin; the nearest initial point is z / 6 behind it."""
    x, y = np.meshgrid(np.linspace(-z, z, 41), np.linspace(-z, z, 41))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], 1)
    n, width = len(points), 0.04 * z
    wall = Gaussians(
        means=torch.from_numpy(points).float(),
        log_scales=torch.tensor([[math.log(width), math.log(width), math.log(1e-3)]]).repeat(n, 1),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        opacity_logits=torch.full((n,), 4.0),
        sh_dc=torch.zeros(n, 3),
        sh_rest=torch.zeros(n, 15, 3),
    )
    camera = orbit_camera(0.0)
    maps = view_maps(ReferenceRasterizer(), wall, camera, cKDTree(points + np.array([0, 0, z / 6])))
    assert np.nanmax(np.abs(maps["depth"] - z)) < 0.01
    assert np.isfinite(maps["depth"]).mean() > 0.99
    assert np.nanmedian(maps["distance"]) == pytest.approx(z / 6, rel=0.04)
    assert np.nanmedian(maps["volume"]) == pytest.approx(4 / 3 * math.pi * width * width * 1e-3, rel=0.01)


def test_what_is_not_covered_is_no_number() -> None:
    camera = orbit_camera(0.0)
    lone = Gaussians(
        means=torch.tensor([[0.0, 0.0, 3.0]]),
        log_scales=torch.full((1, 3), math.log(0.1)),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]),
        opacity_logits=torch.tensor([4.0]),
        sh_dc=torch.zeros(1, 3),
        sh_rest=torch.zeros(1, 15, 3),
    )
    maps = view_maps(ReferenceRasterizer(), lone, camera, cKDTree(np.zeros((1, 3))))
    assert np.isnan(maps["depth"][0, 0])
    assert np.isfinite(maps["depth"][camera.height // 2, camera.width // 2])


def test_unproject_inverts_the_projection() -> None:
    camera = orbit_camera(0.4)
    world = unproject(np.full((camera.height, camera.width), 2.5), camera)
    in_view = world[7, 11] @ camera.rotation.T + camera.translation
    assert in_view[2] == pytest.approx(2.5)
    assert camera.fx * in_view[0] / in_view[2] + camera.cx == pytest.approx(11.5)
    assert camera.fy * in_view[1] / in_view[2] + camera.cy == pytest.approx(7.5)
