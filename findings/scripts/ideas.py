"""Four densifiers of ten lines for the night of ideas (`night.py`)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.densify import ADC
from gsbench.densify.base import Refinement


@dataclass
class OpaqueOnly(ADC):
    """Grow only Gaussians that are at least half opaque: faint ones may be pruned soon."""

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        over, large = super().candidates(refinement)
        return over & (refinement.gaussians.values.opacity_logits.flatten() > 0), large


@dataclass
class SplitNeedles(ADC):
    """Split, rather than clone, Gaussians that are ten times longer than their middle axis."""

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        over, large = super().candidates(refinement)
        scales = refinement.gaussians.values.log_scales.sort(dim=-1).values  # [N, 3]
        return over, large | (scales[:, 2] - scales[:, 1] > 2.3)


@dataclass
class SeenOften(ADC):
    """Grow only Gaussians that were visible at least ten times since the last round."""

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        over, large = super().candidates(refinement)
        return over & (self.statistics["visible_count"].flatten() >= 10), large


@dataclass
class LargestFirst(ADC):
    """Weigh the gradient by the root of the size, so that large Gaussians grow first."""

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        _, large = super().candidates(refinement)
        size = refinement.gaussians.values.log_scales.amax(-1)
        weight = torch.exp(0.5 * (size - size.median()))
        return self.reaches(self.mean_gradient() * weight, self.gradient_threshold), large
