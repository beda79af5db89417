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

REACH = 3.0  # standard deviations at which a Gaussian is taken to end


@dataclass
class LongAxis(ADC):
    """ADC that splits all candidates along their longest axis and clones none (Deng et al., arXiv 2508.12313).

    With d = ``split_distance`` and s the longest semi-axis, two children replace the parent. They lie at 3 d s on
    either side of it along that axis. Their longest semi-axis is (1 - d) s, their other axes are the parent's times
    sqrt(1 - d^2), and their opacity is the parent's times ``opacity_factor``. The split is not random. The options
    ``split_size``, ``split_children``, ``split_shrink`` and ``revised_opacity`` of ADC have no effect.
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
        """Split the Gaussians whose mean gradient reaches the threshold."""
        over, _ = self.candidates(refinement)
        selected, blocked = self.choose(refinement, over, 1)
        parents = selected.nonzero().squeeze(-1)  # [S]
        parent_values = refinement.gaussians.values.detach().select(parents)
        children = halves(parent_values, REACH * self.split_distance, *self._factors, self.opacity_factor)
        self.edit(refinement, ~selected, children, parents.repeat(2), Cause.SPLIT_GRADIENT)
        refinement.event.split_gradient += len(parents)
        refinement.event.blocked_by_cap += blocked

    @property
    def _factors(self) -> tuple[float, float]:
        """Factors on the scale of the longest axis and on those of the other two."""
        return 1 - self.split_distance, math.sqrt(1 - self.split_distance**2)


def halves(parents: Gaussians, offset: float, longest: float, across: float, opacity: float) -> Gaussians:
    """Two children of each of ``parents`` [S], [2 S]: first all children on one side, then all on the other.

    They lie ``offset`` standard deviations from the parent along its longest axis. ``longest`` multiplies the scale of
    that axis, ``across`` the other scales, and ``opacity`` the opacity.
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
    """``log_scales`` [N, 3] with the scale of the longest axis times ``longest`` and the others times ``across``."""
    index = log_scales.argmax(-1, keepdim=True)
    is_longest = torch.zeros_like(log_scales, dtype=torch.bool).scatter(-1, index, True)
    # torch.where with two Python numbers would compute in float32; a tensor keeps float64.
    factors = log_scales.new_tensor([math.log(across), math.log(longest)])
    return log_scales + factors[is_longest.long()]
