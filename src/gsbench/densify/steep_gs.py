"""SteepGS: Gaussians at saddle points of the loss are split along the direction that lowers it most."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple

import torch
from annotated_types import Interval, Lt
from torch import Tensor

from gsbench.densify.adc import ADC, OPACITY_RESET, Grown
from gsbench.densify.base import Refinement, Statistic
from gsbench.densify.budget import admit
from gsbench.densify.operations import faded, standard_normal
from gsbench.events import Cause
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import Switch


class Saddles(NamedTuple):
    """Candidates for growth, with the result of `SteepGS.steepest`."""

    indices: Tensor  # [C], rising
    values: Tensor  # [C], least eigenvalues
    directions: Tensor  # [C, 3], their eigenvectors
    large: Tensor  # mask [N] of all large Gaussians

    def mask(self) -> Tensor:
        """Mask [N] of the candidates."""
        mask = torch.zeros_like(self.large)
        mask[self.indices] = True
        return mask


@dataclass
class SteepGS(ADC):
    """ADC that splits a candidate only where a split lowers the loss (Wang et al., CVPR 2025, arXiv 2505.05587).

    Replace a Gaussian by two halves at small offsets +-d. To second order the loss changes by d S d / 2, where S is the
    splitting matrix: the sum over pixels of (d loss / d s) times the second derivative of s by the mean, with s the
    opacity times the density at the pixel. So a split lowers the loss only if S has a negative eigenvalue, and most
    along the eigenvector of the least eigenvalue. Halves of equal weight are best.

    A candidate of ADC grows only if the least eigenvalue of its S, averaged over the iterations in which it was
    visible, is below ``eigenvalue_threshold``, in units of the loss per squared scene extent (None: no condition). Two
    children replace it, on either side along the eigenvector, with ``opacity_factor`` times its opacity. If it is
    large, their scales are divided by ``split_shrink``, and each offset has the length of a draw from the parent's
    density. If it is small, their scales are the parent's, and the offset is the present learning rate of the means.
    Under a cap, the least eigenvalues come first. ``split_children`` and ``revised_opacity`` have no effect.
    """

    STATISTICS: ClassVar[Mapping[str, torch.dtype | Statistic]] = {
        "splitting_sum": Statistic(torch.float32, (3, 3))  # per world unit squared, since the last refinement
    }
    needs_splitting_matrix = True

    SWITCHES: ClassVar[Mapping[str, Switch]] = {
        "saddle": Switch({"eigenvalue_threshold": None}, "the condition that a split lowers the loss"),
        "halving": Switch({"opacity_factor": 1.0}, "halves of half the opacity"),
        "opacity_reset": OPACITY_RESET,
    }

    eigenvalue_threshold: Annotated[float, Lt(0)] | None = -1e-6
    opacity_factor: Annotated[float, Interval(gt=0, le=1)] = 0.5

    def observe(self, step: int, render: RenderOutput) -> None:
        super().observe(step, render)
        if step < self.stop:
            self.statistics["splitting_sum"] += render.require_splitting_matrix()

    def steepest(self, index: Tensor) -> tuple[Tensor, Tensor]:
        """The least eigenvalue [S] of the mean splitting matrix of the Gaussians at ``index`` [S], and its eigenvector
        [S, 3].

        Eigenvalues are in units of the loss per squared extent. The largest component of each eigenvector is positive.
        """
        seen = self.statistics["visible_count"][index].clamp_min(1)  # [S]
        mean = self.statistics["splitting_sum"][index].double() / seen[:, None, None]  # [S, 3, 3]
        values, vectors = torch.linalg.eigh(mean)  # in rising order
        directions = vectors[..., 0]
        largest = directions.gather(-1, directions.abs().argmax(-1, keepdim=True))  # [S, 1]
        return values[:, 0] * self.context.extent**2, directions * largest.sign()

    def saddles(self, refinement: Refinement) -> Saddles:
        """The candidates of ADC whose split lowers the loss."""
        over, large = super().candidates(refinement)
        index = over.nonzero().squeeze(-1)  # [C]
        values, directions = self.steepest(index)
        if self.eigenvalue_threshold is not None:
            lowering = values < self.eigenvalue_threshold
            index, values, directions = index[lowering], values[lowering], directions[lowering]
        return Saddles(index, values, directions, large)

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        saddles = self.saddles(refinement)
        return saddles.mask(), saddles.large

    def grown(self, refinement: Refinement) -> Grown:
        values = refinement.gaussians.values
        over, large = self.candidates(refinement)
        return Grown(
            torch.where(over, 2, 1),
            values.log_scales - math.log(self.split_shrink) * (over & large).unsqueeze(-1),
            torch.where(over, faded(values.opacity_logits, self.opacity_factor), values.opacity_logits),
        )

    def grow_by_gradient(self, refinement: Refinement) -> None:
        """Replace each candidate by two halves."""
        gaussians = refinement.gaussians
        saddles = self.saddles(refinement)
        gains = torch.zeros(len(gaussians), dtype=torch.float64, device=gaussians.device)
        gains[saddles.indices] = -saddles.values
        selected, blocked = admit(saddles.mask(), gains, 1, self.allowance(refinement))
        indices = selected.nonzero().squeeze(-1)  # [S]
        parents, is_large = gaussians.values.detach().select(indices), saddles.large[indices].unsqueeze(-1)
        direction = saddles.directions[selected[saddles.indices]].to(parents.means)  # [S, 3]
        noise = standard_normal((2 * len(parents), 3), refinement.rng, parents.means)
        lengths = (noise * parents.scales.repeat(2, 1)).norm(dim=-1, keepdim=True)  # [2 S, 1]
        lengths = torch.where(is_large.repeat(2, 1), lengths, gaussians.position_rate)
        children = Gaussians.concatenate([parents, parents])
        children.means = children.means + lengths * torch.cat([direction, -direction])
        children.log_scales = children.log_scales - math.log(self.split_shrink) * is_large.repeat(2, 1)
        children.opacity_logits = faded(children.opacity_logits, self.opacity_factor)
        self.edit(refinement, ~selected, children, indices.repeat(2), Cause.SPLIT_GRADIENT)
        refinement.event.split_gradient += len(parents)
        refinement.event.blocked_by_cap += blocked
