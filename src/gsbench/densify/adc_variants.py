"""Variants of ADC: other criteria of growth, and another way to split."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from annotated_types import Interval, Lt
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.adc import ADC, Grown
from gsbench.densify.base import Refinement, Rule, Statistic
from gsbench.densify.budget import admit
from gsbench.densify.scores import faded, quantile, standard_normal
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import OpenFraction


@dataclass
class AbsGS(ADC):
    """ADC with two gradients and a ceiling on opacities (Ye et al., arXiv 2404.10484).

    It follows the authors' code. Small Gaussians are cloned if their signed mean gradient reaches
    ``gradient_threshold``. Large ones are split if their absolute mean gradient, in which the
    pixels of a Gaussian do not cancel, reaches ``split_threshold``. Every ``ceiling_interval``
    iterations, all opacities above ``opacity_ceiling`` are lowered to it, so that no Gaussian hides
    all that is behind it.
    """

    # NDC, since the last refinement
    STATISTICS: ClassVar = {"absolute_sum": torch.float32}
    needs_absolute_gradient = True

    split_size: PositiveFloat = 0.001
    split_threshold: PositiveFloat = 4e-4  # of splits, by the absolute gradient
    opacity_ceiling: OpenFraction = 0.8
    ceiling_interval: PositiveInt = 500

    def gather(self, render: RenderOutput) -> None:
        super().gather(render)
        assert render.screen_gradient_abs is not None  # because of needs_absolute_gradient
        self.statistics["absolute_sum"] += torch.where(
            render.visible, render.screen_gradient_abs.norm(dim=-1), 0.0
        )

    def mean_absolute_gradient(self) -> Tensor:
        """Absolute mean gradient [N] NDC over the iterations in which a Gaussian was visible."""
        return self.mean("absolute_sum")

    def rules(self, refinement: Refinement) -> list[Rule]:
        """The rules of ADC, with the ceiling inserted before the opacity reset."""
        rules, step = super().rules(refinement), refinement.step
        if step < self.stop and step % self.ceiling_interval == 0:
            rules.insert(len(rules) - (self.reset_opacity in rules), self.lower_opacity)
        return rules

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        over, large = super().candidates(refinement)
        limit = self.split_threshold * refinement.strictness
        split = self.reaches(self.mean_absolute_gradient(), limit)
        return torch.where(large, split, over), large

    def choose(self, refinement: Refinement, candidates: Tensor, gain: int) -> tuple[Tensor, int]:
        """Choose the candidates farthest above the threshold that applies to them."""
        _, large = self.candidates(refinement)
        signed = self.mean_gradient() / self.gradient_threshold
        absolute = self.mean_absolute_gradient() / self.split_threshold
        excess = torch.where(large, absolute, signed)  # [N]
        return admit(candidates, excess, gain, self.allowance(refinement))

    def lower_opacity(self, refinement: Refinement) -> None:
        """Lower all opacities above the ceiling to it."""
        self.limit_opacity(refinement, self.opacity_ceiling)


@dataclass
class PixelGS(ADC):
    """ADC with the growth condition of Zhang et al. (arXiv 2403.15530).

    The mean gradient is sum_k m_ik f_ik |g_ik| / sum_k m_ik, where m_ik is the number of pixels
    that Gaussian i is blended into in view k, g_ik its gradient and z_ik its depth there. So views
    that see only an edge of a large Gaussian no longer lower its mean. The factor f_ik = min(1,
    (z_ik / (``near_fraction`` extent))^2) reduces growth near cameras. Only growth uses this mean;
    the optimiser's gradients are not changed.
    """

    STATISTICS: ClassVar = {
        "weighted_gradient_sum": torch.float32,  # NDC px, since the last refinement
        "pixel_sum": torch.int64,  # px
    }

    near_fraction: PositiveFloat | None = 0.37  # of the scene extent; None: f = 1
    needs_footprint = True

    def gather(self, render: RenderOutput) -> None:
        super().gather(render)
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
        """Mean gradient [N] NDC over the views since the last refinement, weighted by pixels."""
        return self.mean("weighted_gradient_sum", "pixel_sum")


@dataclass
class QuantileADC(ADC):
    """ADC with a growth rate, after the AdaptiveStrategy of gsplat's pull request 941.

    Each round grows the Gaussians with the largest mean gradients, so many that the count rises by
    the share ``growth_rate``. Gaussians without a gradient do not grow. The share ``prune_share``
    of all Gaussians, those with the lowest opacities, is pruned. Huge Gaussians are pruned as in
    ADC.
    """

    growth_rate: PositiveFloat = 0.05  # of the present count, in each round
    # with the lowest opacities, in each round
    prune_share: Annotated[float, Interval(ge=0, lt=1)] = 0.01

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        _, large = super().candidates(refinement)
        mean = self.mean_gradient()
        gain = self.split_children - 1
        count = int(self.growth_rate / refinement.strictness * len(mean)) // gain
        largest = torch.zeros_like(large)
        largest[mean.sort(descending=True, stable=True).indices[:count]] = True
        return largest & (mean > 0), large

    def forecast(self, refinement: Refinement) -> int:
        # The opacity threshold is a quantile over all Gaussians after growth, so each child needs
        # its own entry.
        grown = self.grown(refinement)
        index = torch.repeat_interleave(grown.number)  # [after growth] each child's parent
        faint = self.faint(grown.opacity_logits[index], refinement.cull)
        pruned = faint | self.huge(refinement.step, grown.log_scales)[index]
        return len(index) - int(pruned.sum())

    def faint(self, opacity_logits: Tensor, cull: float) -> Tensor:
        if len(opacity_logits) == 0:
            return torch.zeros_like(opacity_logits, dtype=torch.bool)
        share = min(self.prune_share * cull, 1.0)
        return opacity_logits < quantile(opacity_logits.detach().sort().values, share)


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

    STATISTICS: ClassVar = {
        # per world unit squared, since the last refinement
        "splitting_sum": Statistic(torch.float32, (3, 3))
    }
    needs_extra = "splitting_matrix"

    eigenvalue_threshold: Annotated[float, Lt(0)] | None = -1e-6  # loss per squared extent
    opacity_factor: Annotated[float, Interval(gt=0, le=1)] = 0.5

    def gather(self, render: RenderOutput) -> None:
        super().gather(render)
        self.statistics["splitting_sum"] += render.require_extra()

    def saddles(self, refinement: Refinement) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The candidates of ADC whose split lowers the loss, as a mask [N], and where to split.

        The rest is a mask [N] of all large Gaussians and, for the candidates of ADC, the least
        eigenvalue [N] of the mean splitting matrix, in units of the loss per squared extent, with
        its eigenvector [N, 3], whose largest component is positive.
        """
        over, large = super().candidates(refinement)
        seen = self.statistics["visible_count"][over].clamp_min(1)  # [S]
        mean = self.statistics["splitting_sum"][over].double() / seen[:, None, None]  # [S, 3, 3]
        eigenvalues, vectors = torch.linalg.eigh(mean)  # in rising order
        steepest = vectors[..., 0]
        largest = steepest.gather(-1, steepest.abs().argmax(-1, keepdim=True))  # [S, 1]
        values = torch.zeros(len(over), dtype=torch.float64, device=over.device)
        directions = values.new_zeros(len(over), 3)
        values[over] = eigenvalues[:, 0] * self.context.extent**2
        directions[over] = steepest * largest.sign()
        if self.eigenvalue_threshold is not None:
            over = over & (values < self.eigenvalue_threshold)
        return over, large, values, directions

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        return self.saddles(refinement)[:2]

    def grown(self, refinement: Refinement) -> Grown:
        values = refinement.gaussians.values
        over, large = self.candidates(refinement)
        log_scales = values.log_scales - math.log(self.split_shrink) * large.unsqueeze(-1)
        return Grown.halved(values, over, log_scales, self.opacity_factor)

    def grow_by_gradient(self, refinement: Refinement) -> None:
        """Replace each candidate by two halves."""
        gaussians = refinement.gaussians
        over, large, values, directions = self.saddles(refinement)
        selected, blocked = admit(over, -values, 1, self.allowance(refinement))
        parents = gaussians.values.select(selected)
        is_large = large[selected].unsqueeze(-1)  # [S, 1]
        direction = directions[selected].to(parents.means)  # [S, 3]
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
