"""Pixel-GS: ADC whose mean gradient weights each view by the number of pixels that a Gaussian covers."""

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

    The mean gradient is sum_k m_ik f_ik |g_ik| / sum_k m_ik, where m_ik is the number of pixels that Gaussian i is
    blended into in view k, g_ik its gradient and z_ik its depth there. So views that see only an edge of a large
    Gaussian no longer lower its mean. The factor f_ik = min(1, (z_ik / (``near_fraction`` extent))^2) reduces growth
    near cameras. Only growth uses this mean; the optimiser's gradients are not changed.
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
        """The factor f in [0, 1] for view depths [N]."""
        if self.near_fraction is None:
            return torch.ones_like(depths)
        return (depths / (self.near_fraction * self.context.extent)).square().clamp_max(1)

    def mean_gradient(self) -> Tensor:
        """Mean gradient [N] NDC over the views since the last refinement, weighted by pixels; 0 without pixels."""
        return self.statistics["weighted_gradient_sum"] / self.statistics["pixel_sum"].clamp_min(1)
