"""The parts of the CUDA executor that need no GPU; the contract test runs it whole where there is one."""

from __future__ import annotations

import pytest
import torch

from gsbench.errors import InputError
from gsbench.raster import CONSTANTS, create_rasterizer, resolve_name
from gsbench.raster.cuda import _matrices, _reaches_image, _square_radii
from gsbench.raster.reference import project, tile_rectangles
from tests.gaussians.helpers import front_camera, random_gaussians


def test_square_radii_are_those_of_the_reference() -> None:
    projected = project(random_gaussians(300, seed=4, log_scale=(-4, 0.5)), front_camera(64, 48))
    seen = torch.ones(1, len(projected.index), dtype=torch.bool)
    radii = _square_radii(projected.conics.unsqueeze(0), seen, CONSTANTS)[0]
    assert (radii - projected.radii).abs().max() <= 1  # ceil may fall either way on an exact integer
    assert (radii == projected.radii).double().mean() > 0.99


def test_reach_agrees_with_the_tiles_of_the_reference() -> None:
    camera = front_camera(64, 48)
    projected = project(random_gaussians(300, seed=6, log_scale=(-4, 0)), camera)
    low, high = tile_rectangles(projected, camera, CONSTANTS.tile)
    reached = ((high - low) > 0).all(-1)
    ours = _reaches_image(projected.means + 0.5, projected.radii, 64, 48)
    assert (ours | ~reached).all()  # whatever reaches a tile there reaches the image here


def test_matrices_take_the_world_to_pixels() -> None:
    camera = front_camera(64, 48, (3.0, -2.0))
    point = torch.tensor([0.3, -0.2, 4.0], dtype=torch.float64)
    view, intrinsics = _matrices(camera, point)
    pixel = intrinsics[0] @ (view[0] @ torch.cat([point, torch.ones(1)]))[:3]
    expected = camera.rotation @ point.numpy() + camera.translation
    assert float(pixel[0] / pixel[2]) == pytest.approx(camera.fx * expected[0] / expected[2] + camera.cx)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a CUDA device")
def test_without_a_gpu_the_error_says_so_at_once() -> None:
    with pytest.raises(InputError, match="needs a CUDA device"):
        create_rasterizer("cuda", torch.device("cpu"))


def test_names() -> None:
    assert resolve_name("auto", torch.device("cpu")) == "cpu"
    assert resolve_name("reference", torch.device("cpu")) == "reference"
    with pytest.raises(InputError, match="choose auto, reference, cpu, cuda"):
        resolve_name("opengl", torch.device("cpu"))
