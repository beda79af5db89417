"""Pixel-GS: ADC whose mean gradient weighs each view by the pixels that a Gaussian covers in it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from pydantic import PositiveFloat
from torch import Tensor

from gsbench.densify.adc import ADC, OPACITY_RESET
from gsbench.raster.base import RenderOutput
from gsbench.settings import Switch


@dataclass
class PixelGS(ADC):
    """ADC with the growth condition of Zhang et al. (arXiv 2403.15530).

    With m_ik the pixels that Gaussian i is blended into in view k, g_ik its gradient there and z_ik its view z, the
    mean gradient is sum_k m_ik f_ik |g_ik| / sum_k m_ik: a large Gaussian of which many views see but an edge is no
    longer held back by them. f_ik = min(1, (z_ik / (``near_fraction`` extent))^2) holds back what is near a camera.
    Only growth reads it; the optimiser's gradients stay as they are.
    """

    STATISTICS: ClassVar[dict[str, torch.dtype]] = {
        "weighted_gradient_sum": torch.float32,  # NDC px, since the last refinement
        "pixel_sum": torch.int64,  # px
    }

    SWITCHES: ClassVar[Mapping[str, Switch]] = {
        "near_scaling": Switch({"near_fraction": None}, "less growth near the cameras"),
        "opacity_reset": OPACITY_RESET,
    }

    near_fraction: PositiveFloat | None = 0.37  # of the scene extent; None: f = 1
    needs_footprint = True

    def observe(self, step: int, render: RenderOutput) -> None:
        super().observe(step, render)
        if step >= self.stop:
            return
        footprint = render.require_footprint()
        weights = footprint.pixels * self.nearness(footprint.depths)  # [N] px
        self.statistics["weighted_gradient_sum"] += weights * self.screen_gradient(render)
        self.statistics["pixel_sum"] += footprint.pixels

    def nearness(self, depths: Tensor) -> Tensor:
        """The factor f for view depths [N], in [0, 1]."""
        if self.near_fraction is None:
            return torch.ones_like(depths)
        return (depths / (self.near_fraction * self.context.extent)).square().clamp_max(1)

    def mean_gradient(self) -> Tensor:
        """[N] NDC, over the views since the last refinement, each weighed by its pixels; 0 without any."""
        return self.statistics["weighted_gradient_sum"] / self.statistics["pixel_sum"].clamp_min(1)
