"""What the Triton rasterizer promises beyond the contract, in Triton's interpreter; run by ``test_triton.py``."""

from __future__ import annotations

import pytest
import torch

from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import RenderOutput
from gsbench.raster.contract import Case, render_with_gradients
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.raster.triton import TritonRasterizer

BLACK = torch.zeros(3)
SMALL = Case(33, 49, 50, sh_degree=3)


def _bits(output: RenderOutput, gradients: dict[str, torch.Tensor]) -> list[bytes]:
    tensors = [output.image, output.alpha, output.radii, *gradients.values()]
    return [tensor.detach().numpy().tobytes() for tensor in tensors]


def test_the_same_bits_on_every_run() -> None:
    rasterizer = TritonRasterizer()
    expected = _bits(*render_with_gradients(rasterizer, SMALL, torch.float32))
    assert _bits(*render_with_gradients(rasterizer, SMALL, torch.float32)) == expected  # memory that was used before
    assert _bits(*render_with_gradients(TritonRasterizer(), SMALL, torch.float32)) == expected


def test_equal_depths_are_blended_in_the_order_of_the_index() -> None:
    gaussians = Gaussians(
        torch.tensor([[0.3, 0.2, 3.0]] * 5),
        torch.full((5, 3), -1.0),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 5),
        torch.ones(5),
        torch.eye(5)[:, :3] * 3,
        torch.zeros(5, 15, 3),
    )
    camera = SMALL.camera()
    image = TritonRasterizer().render(gaussians, camera, 0, BLACK).image
    reference = ReferenceRasterizer().render(gaussians.map(torch.Tensor.double), camera, 0, BLACK.double()).image
    assert (image - reference).abs().max() < 1e-5
    assert reference.max() > 0.5


def test_float64_is_refused() -> None:
    with pytest.raises(ValueError, match="float32"):
        TritonRasterizer().render(SMALL.gaussians(), SMALL.camera(), 0, BLACK.double())
