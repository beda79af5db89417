"""SteepGS: a Gaussian is split only where a split lowers the loss."""

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
from gsbench.densify.formulas import faded, standard_normal
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import Switch


class Saddles(NamedTuple):
    """Candidates for growth, with the result of `SteepGS.steepest` for each."""

    candidates: Tensor  # mask [N]
    large: Tensor  # mask [N] of all large Gaussians
    values: Tensor  # [N], least eigenvalues
    directions: Tensor  # [N, 3], their eigenvectors


@dataclass
class SteepGS(ADC):
    """ADC that splits only where a split lowers the loss (Wang et al., arXiv 2505.05587).

    Consider a split of a Gaussian into two halves at small offsets +-d. To second order, the loss
    changes by d S d / 2, where S is the splitting matrix: the sum over pixels of (d loss / d s)
    times the second derivative of s by the mean, with s the opacity times the density at the pixel.
    So a split lowers the loss only if S has a negative eigenvalue, and lowers it most along the
    eigenvector of the least eigenvalue. Halves of equal weight are best.

    A candidate of ADC grows only if the least eigenvalue of its S, averaged over the iterations in
    which it was visible, is below ``eigenvalue_threshold``, in units of the loss per squared scene
    extent (None: no condition). Two children replace it, on either side along the eigenvector, with
    ``opacity_factor`` times its opacity. If it is large, their scales are divided by
    ``split_shrink``, and each offset has the length of a draw from the parent's density. If it is
    small, their scales are the parent's, and the offset is the present learning rate of the means.
    Under a cap, candidates with the least eigenvalues come first. ``split_children`` and
    ``revised_opacity`` have no effect.
    """

    STATISTICS: ClassVar[Mapping[str, torch.dtype | Statistic]] = {
        # per world unit squared, since the last refinement
        "splitting_sum": Statistic(torch.float32, (3, 3))
    }
    needs_extra = "splitting_matrix"

    SWITCHES: ClassVar[Mapping[str, Switch]] = {
        "saddle": Switch(
            {"eigenvalue_threshold": None}, "the condition that a split lowers the loss"
        ),
        "halving": Switch({"opacity_factor": 1.0}, "halves of half the opacity"),
        "opacity_reset": OPACITY_RESET,
    }

    eigenvalue_threshold: Annotated[float, Lt(0)] | None = -1e-6  # loss per squared extent
    opacity_factor: Annotated[float, Interval(gt=0, le=1)] = 0.5

    def observe(self, step: int, render: RenderOutput) -> None:
        super().observe(step, render)
        if step < self.stop:
            self.statistics["splitting_sum"] += render.require_extra()

    def steepest(self, where: Tensor) -> tuple[Tensor, Tensor]:
        """The least eigenvalue [S] of each mean splitting matrix, and its eigenvector [S, 3].

        The S Gaussians are those at the mask ``where`` [N]. Eigenvalues are in units of the loss
        per squared extent. The largest component of each eigenvector is positive.
        """
        seen = self.statistics["visible_count"][where].clamp_min(1)  # [S]
        mean = self.statistics["splitting_sum"][where].double() / seen[:, None, None]  # [S, 3, 3]
        values, vectors = torch.linalg.eigh(mean)  # in rising order
        directions = vectors[..., 0]
        largest = directions.gather(-1, directions.abs().argmax(-1, keepdim=True))  # [S, 1]
        return values[:, 0] * self.context.extent**2, directions * largest.sign()

    def saddles(self, refinement: Refinement) -> Saddles:
        """The candidates of ADC whose split lowers the loss."""
        over, large = super().candidates(refinement)
        values = torch.zeros(len(over), dtype=torch.float64, device=over.device)
        directions = values.new_zeros(len(over), 3)
        values[over], directions[over] = self.steepest(over)
        if self.eigenvalue_threshold is not None:
            over = over & (values < self.eigenvalue_threshold)
        return Saddles(over, large, values, directions)

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        saddles = self.saddles(refinement)
        return saddles.candidates, saddles.large

    def grown(self, refinement: Refinement) -> Grown:
        values = refinement.gaussians.values
        over, large = self.candidates(refinement)
        log_scales = values.log_scales - math.log(self.split_shrink) * large.unsqueeze(-1)
        return Grown.halved(
            values, over, log_scales, faded(values.opacity_logits, self.opacity_factor)
        )

    def grow_by_gradient(self, refinement: Refinement) -> None:
        """Replace each candidate by two halves."""
        gaussians = refinement.gaussians
        saddles = self.saddles(refinement)
        selected, blocked = admit(
            saddles.candidates, -saddles.values, 1, self.allowance(refinement)
        )
        parents = gaussians.values.detach().select(selected)
        is_large = saddles.large[selected].unsqueeze(-1)  # [S, 1]
        direction = saddles.directions[selected].to(parents.means)  # [S, 3]
        noise = standard_normal((2 * len(parents), 3), refinement.rng, parents.means)
        lengths = (noise * parents.scales.repeat(2, 1)).norm(dim=-1, keepdim=True)  # [2 S, 1]
        lengths = torch.where(is_large.repeat(2, 1), lengths, gaussians.position_rate)
        children = Gaussians.concatenate([parents, parents])
        children.means = children.means + lengths * torch.cat([direction, -direction])
        shrink = math.log(self.split_shrink) * is_large  # [S, 1]
        children.log_scales = children.log_scales - shrink.repeat(2, 1)
        children.opacity_logits = faded(children.opacity_logits, self.opacity_factor)
        self.split_in_halves(refinement, selected, children)
        refinement.event.blocked_by_cap += blocked
