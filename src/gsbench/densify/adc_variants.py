"""Variants of ADC: other criteria of growth, and another way to split."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from annotated_types import Interval
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.adc import ADC, OPACITY_RESET
from gsbench.densify.base import NEVER, Refinement, Rule
from gsbench.densify.budget import admit
from gsbench.densify.formulas import quantile
from gsbench.raster.base import RenderOutput
from gsbench.settings import OpenFraction, Switch


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
    STATISTICS: ClassVar[dict[str, torch.dtype]] = {"absolute_sum": torch.float32}
    needs_absolute_gradient = True

    SWITCHES: ClassVar[Mapping[str, Switch]] = {
        "opacity_ceiling": Switch({"ceiling_interval": NEVER}, "the ceiling on opacities"),
        "small_split_size": Switch(
            {"split_size": ADC.split_size}, "the smaller size above which a Gaussian is split"
        ),
        "opacity_reset": OPACITY_RESET,
    }

    split_size: PositiveFloat = 0.001
    split_threshold: PositiveFloat = 4e-4  # of splits, by the absolute gradient
    opacity_ceiling: OpenFraction = 0.8
    ceiling_interval: PositiveInt = 500

    def observe(self, step: int, render: RenderOutput) -> None:
        super().observe(step, render)
        if step < self.stop:
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
        count = int(self.growth_rate / refinement.strictness * len(mean)) // (
            self.split_children - 1
        )
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
