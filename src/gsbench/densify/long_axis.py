"""The long-axis split of Improved-GS: every candidate of ADC becomes two halves along its longest axis."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from annotated_types import Interval
from torch import Tensor

from gsbench.densify.adc import ADC, OPACITY_RESET, Grown
from gsbench.densify.base import Refinement
from gsbench.densify.operations import faded
from gsbench.events import Cause
from gsbench.gaussians.model import Gaussians
from gsbench.settings import OpenFraction, Switch

REACH = 3.0  # standard deviations: where a Gaussian is taken to end


@dataclass
class LongAxis(ADC):
    """ADC whose candidates are all split, none cloned, in the way of Deng et al. (arXiv 2508.12313).

    With d = ``split_distance`` and the longest semi-axis s: two children at 3 d s on either side of the parent along
    that axis, which becomes (1 - d) s; the other axes are multiplied by sqrt(1 - d^2), the opacity by
    ``opacity_factor``; the parent goes. Nothing is drawn at random. The options ``split_size``, ``split_children``,
    ``split_shrink`` and ``revised_opacity`` of ADC have no meaning here.
    """

    SWITCHES: ClassVar[Mapping[str, Switch]] = {
        "fading": Switch({"opacity_factor": 1.0}, "children fainter than their parent"),
        "opacity_reset": OPACITY_RESET,
    }

    split_distance: OpenFraction = 0.45
    opacity_factor: Annotated[float, Interval(gt=0, le=1)] = 0.6

    def grown(self, refinement: Refinement) -> Grown:
        values = refinement.gaussians.values
        over, _ = self.candidates(refinement)
        log_scales = shrunk(values.log_scales, *self._factors)
        logits = faded(values.opacity_logits, self.opacity_factor)
        return Grown(
            torch.where(over, 2, 1),
            torch.where(over.unsqueeze(-1), log_scales, values.log_scales),
            torch.where(over, logits, values.opacity_logits),
        )

    def grow_by_gradient(self, refinement: Refinement) -> None:
        """Split those whose mean gradient reaches the threshold."""
        over, _ = self.candidates(refinement)
        selected, blocked = self.choose(refinement, over, 1)
        parents = selected.nonzero().squeeze(-1)  # [S]
        chosen = refinement.gaussians.values.detach().select(parents)
        children = halves(chosen, REACH * self.split_distance, *self._factors, self.opacity_factor)
        self.edit(refinement, ~selected, children, parents.repeat(2), Cause.SPLIT_GRADIENT)
        refinement.event.split_gradient += len(parents)
        refinement.event.blocked_by_cap += blocked

    @property
    def _factors(self) -> tuple[float, float]:
        """On the longest axis, and on the others."""
        return 1 - self.split_distance, math.sqrt(1 - self.split_distance**2)


def halves(parents: Gaussians, offset: float, longest: float, across: float, opacity: float) -> Gaussians:
    """Two children of each of ``parents`` [S], first all on the one side, then all on the other, [2 S].

    They stand ``offset`` standard deviations away along the longest axis, which is multiplied by ``longest``, the
    others by ``across``, the opacity by ``opacity``.
    """
    axis = parents.log_scales.argmax(-1)  # [S]
    directions = parents.rotations[torch.arange(len(axis), device=axis.device), :, axis]  # [S, 3]
    offsets = offset * parents.scales.amax(-1, keepdim=True) * directions
    children = Gaussians.concatenate([parents, parents])
    children.means = torch.cat([parents.means + offsets, parents.means - offsets])
    children.log_scales = shrunk(children.log_scales, longest, across)
    children.opacity_logits = faded(children.opacity_logits, opacity)
    return children


def shrunk(log_scales: Tensor, longest: float, across: float) -> Tensor:
    """``log_scales`` [N, 3] with a factor on the longest axis and one on the others."""
    index = log_scales.argmax(-1, keepdim=True)
    is_longest = torch.zeros_like(log_scales, dtype=torch.bool).scatter(-1, index, True)
    factors = log_scales.new_tensor([math.log(across), math.log(longest)])  # two plain numbers would become float32
    return log_scales + factors[is_longest.long()]
