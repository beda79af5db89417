"""The adapter for gsplat: its radii without a GPU, all else on one."""

import pytest
import torch

from benchmarks.gsplat_raster import GsplatRasterizer, _reaches_image, _square_radii
from gsbench.raster.contract import Case, departures
from gsbench.raster.reference import project, tile_rectangles
from tests.gaussians.helpers import front_camera, random_gaussians

# no alpha reaches a clamp
FAINT = Case(50, 37, 60, sh_degree=3, log_scale=-2.0, logit=-3.0, principal=(3.0, -2.0))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_a_gpu_only_radii_depart_from_the_contract():
    pytest.importorskip("gsplat")
    told = departures(GsplatRasterizer(), "cuda", cases=(FAINT,))
    assert [line for line in told if "radius" not in line] == []


def test_square_radii_are_those_of_the_reference_and_reach_the_image_as_its_tiles_do():
    camera = front_camera(64, 48)
    projected = project(random_gaussians(300, seed=4, log_scale=(-4, 0.5)), camera)
    seen = torch.ones(1, len(projected.index), dtype=torch.bool)
    radii = _square_radii(projected.conics.unsqueeze(0), seen)[0]
    # near an integer, rounding may change the ceil
    assert (radii - projected.radii).abs().max() <= 1
    assert (radii == projected.radii).double().mean() > 0.99
    low, high = tile_rectangles(projected, camera)
    reached = ((high - low) > 0).all(-1)
    assert (_reaches_image(projected.means + 0.5, projected.radii, 64, 48) | ~reached).all()
