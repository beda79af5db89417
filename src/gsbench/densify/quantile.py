"""ADC whose gradient threshold is what lets the count grow at a given rate."""

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
    """ADC with a rate instead of a threshold, after the proposal of an AdaptiveStrategy for gsplat (its PR 941).

    In each round those of the largest mean gradients grow, so many that the count grows by ``growth_rate``; of those
    that were never seen, nobody. The faintest ``prune_share`` go, and the huge as in ADC.
    """

    growth_rate: PositiveFloat = 0.05
    prune_share: Annotated[float, Interval(ge=0, lt=1)] = 0.01

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        _, large = super().candidates(refinement)
        mean = self.mean_gradient()
        places = int(self.growth_rate / self.strictness * len(mean)) // max(1, self.split_children - 1)
        chosen = torch.zeros_like(large)
        chosen[mean.sort(descending=True, stable=True).indices[:places]] = True
        return chosen & (mean > 0), large

    def forecast(self, refinement: Refinement) -> int:
        grown = self.grown(refinement)
        index = torch.arange(len(grown.number), device=grown.number.device).repeat_interleave(grown.number)
        gone = self.faint(grown.opacity_logits[index]) | self.huge(refinement.step, grown.log_scales)[index]
        return len(index) - int(gone.sum())

    def faint(self, opacity_logits: Tensor) -> Tensor:
        if len(opacity_logits) == 0:
            return torch.zeros_like(opacity_logits, dtype=torch.bool)
        share = min(self.prune_share * self.cull, 1.0)
        return opacity_logits < quantile(opacity_logits.detach().sort().values, share)
