"""The long-axis split of Improved-GS: whom ADC would clone or split becomes two halves along its longest axis."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval
from torch import Tensor

from gsbench.densify.adc import ADC, Grown
from gsbench.densify.base import Refinement
from gsbench.events import Cause
from gsbench.gaussians.model import Gaussians
from gsbench.settings import OpenFraction

REACH = 3.0  # standard deviations: where a Gaussian is taken to end


@dataclass
class LongAxis(ADC):
    """ADC whose candidates are all split, none cloned, in the way of Deng et al. (arXiv 2508.12313).

    With d = ``split_distance`` and the longest semi-axis s: two children at 3 d s on either side of the parent along
    that axis, which becomes (1 - d) s; the other axes are multiplied by sqrt(1 - d^2), the opacity by
    ``opacity_factor``; the parent goes. Nothing is drawn at random. The options ``split_size``, ``split_children``,
    ``split_shrink`` and ``revised_opacity`` of ADC have no meaning here.
    """

    split_distance: OpenFraction = 0.45
    opacity_factor: Annotated[float, Interval(gt=0, le=1)] = 0.6

    def grown(self, refinement: Refinement) -> Grown:
        values = refinement.gaussians.values
        over, _ = self.candidates(refinement)
        log_scales, logits = self._shrunk(values.log_scales), self._faded(values.opacity_logits)
        return Grown(
            torch.where(over, 2, 1),
            torch.where(over.unsqueeze(-1), log_scales, values.log_scales),
            torch.where(over, logits, values.opacity_logits),
        )

    def grow_by_gradient(self, refinement: Refinement) -> None:
        """Split whose mean gradient reaches the threshold."""
        over, _ = self.candidates(refinement)
        selected, blocked = self.choose(refinement, over, 1)
        parents = selected.nonzero().squeeze(-1)  # [S]
        half = refinement.gaussians.values.detach().select(parents)
        longest = half.log_scales.argmax(-1)  # [S]
        directions = half.rotations[torch.arange(len(parents), device=longest.device), :, longest]  # [S, 3]
        offsets = REACH * self.split_distance * half.scales.amax(-1, keepdim=True) * directions
        half.log_scales, half.opacity_logits = self._shrunk(half.log_scales), self._faded(half.opacity_logits)
        children = Gaussians.concatenate([half, half])
        children.means = torch.cat([half.means + offsets, half.means - offsets])
        self.edit(refinement, ~selected, children, parents.repeat(2), Cause.SPLIT_GRADIENT)
        refinement.event.split_gradient += len(parents)
        refinement.event.blocked_by_cap += blocked

    def _shrunk(self, log_scales: Tensor) -> Tensor:
        """Log scales of the children, [N, 3]."""
        longest = torch.zeros_like(log_scales, dtype=torch.bool).scatter(-1, log_scales.argmax(-1, keepdim=True), True)
        across = math.log(math.sqrt(1 - self.split_distance**2))
        return log_scales + torch.where(longest, math.log(1 - self.split_distance), across)

    def _faded(self, opacity_logits: Tensor) -> Tensor:
        return torch.logit(self.opacity_factor * opacity_logits.sigmoid())
