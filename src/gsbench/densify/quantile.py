"""ADC that grows at a given rate instead of by a fixed gradient threshold."""

from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval
from pydantic import PositiveFloat
from torch import Tensor

from gsbench.densify.adc import ADC
from gsbench.densify.base import Refinement
from gsbench.densify.operations import quantile


@dataclass
class QuantileADC(ADC):
    """ADC with a growth rate, after the AdaptiveStrategy proposed for gsplat (its pull request 941).

    In each round the Gaussians with the largest mean gradients grow, as many as raise the count by ``growth_rate``.
    Gaussians that no view has seen do not grow. The ``prune_share`` with the lowest opacities are pruned, and huge
    Gaussians are pruned as in ADC.
    """

    growth_rate: PositiveFloat = 0.05
    prune_share: Annotated[float, Interval(ge=0, lt=1)] = 0.01

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        _, large = super().candidates(refinement)
        mean = self.mean_gradient()
        count = int(self.growth_rate / self.strictness * len(mean)) // max(1, self.split_children - 1)
        largest = torch.zeros_like(large)
        largest[mean.sort(descending=True, stable=True).indices[:count]] = True
        return largest & (mean > 0), large

    def forecast(self, refinement: Refinement) -> int:
        # The opacity threshold is a quantile over all Gaussians after growth, so each child needs its own entry.
        grown = self.grown(refinement)
        index = torch.arange(len(grown.number), device=grown.number.device).repeat_interleave(grown.number)
        pruned = self.faint(grown.opacity_logits[index]) | self.huge(refinement.step, grown.log_scales)[index]
        return len(index) - int(pruned.sum())

    def faint(self, opacity_logits: Tensor) -> Tensor:
        if len(opacity_logits) == 0:
            return torch.zeros_like(opacity_logits, dtype=torch.bool)
        share = min(self.prune_share * self.cull, 1.0)
        return opacity_logits < quantile(opacity_logits.detach().sort().values, share)
