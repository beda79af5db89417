"""MRNF, the default strategy of LichtFeld-Studio: a few long-axis splits, drawn by error and edges, and decay."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import torch
from annotated_types import Interval
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.base import Refinement, Rule
from gsbench.densify.budget import Budgeted
from gsbench.densify.long_axis import halves
from gsbench.densify.mcmc import spread_out
from gsbench.densify.operations import standard_normal
from gsbench.densify.scores import blended_sums, by_median, draw, draw_views, edge_scores
from gsbench.events import Cause
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import Fraction, OpenFraction, Switch

# Constants from LichtFeld-Studio's code (src/training/strategies/mrnf.cpp, kernels/mrnf_kernels.cu).
EDGE_WEIGHT = 0.25  # weights of draws are multiplied by 1 + this times (edge score / its median)
REACH = 100.0  # times half the scene's size: Gaussians that are farther or larger are pruned
MIN_SCALE = 1e-10  # world units; smaller Gaussians are pruned
BOUNDS = (0.1, 0.9)  # quantiles of the means on each axis that bound the scene
NOISE_POWER = 150.0  # noise is proportional to (1 - opacity) to this power
SPLIT_OFFSET = 0.5  # standard deviations
SPLIT_LONGEST, SPLIT_ACROSS, SPLIT_OPACITY = 0.5, 0.85, 0.6  # factors on the children's scales and opacity
MIN_DECAYED = 1e-12  # of opacities and scales after decay


@dataclass
class MRNF(Budgeted):
    """Each round replaces pruned Gaussians and adds a small share by long-axis splits; opacities and scales decay.

    The refine weight of a Gaussian is the largest sum over pixels of e alpha T in ``score_views`` training views, drawn
    in each round, where e = max(0, 1 - SSIM) divided by its mean in the view. Candidates are the Gaussians seen since
    the last round whose weight is above ``growth_threshold``. A round prunes Gaussians below ``prune_opacity`` and
    those too small, too large or too far away. Then it splits:

    1. as many Gaussians as it pruned, drawn by opacity;
    2. until iteration ``grow_until``, further candidates, drawn by refine weight, so that the two splits together are
       the ``growth_share`` of all candidates.

    Both draws also favour Gaussians that cover edges. After each round every opacity decreases by ``opacity_decay`` and
    every scale by the share ``scale_decay``; both amounts fall to 0 at iteration ``decay_until``. After each step, the
    means of faint Gaussians get noise.
    """

    STATISTICS: ClassVar[dict[str, torch.dtype]] = {"seen": torch.bool}  # since the last round

    SWITCHES: ClassVar[Mapping[str, Switch]] = {
        "noise": Switch({"noise_rate": 0.0}, "noise on the means"),
        "opacity_decay": Switch({"opacity_decay": 0.0}, "opacities that decay"),
        "scale_decay": Switch({"scale_decay": 0.0}, "scales that decay"),
    }

    start: NonNegativeInt = 0
    stop: int = 25_000
    interval: PositiveInt = 200
    max_gaussians: PositiveInt = 1_000_000
    cap: Literal["hard", "curve"] = "hard"
    grow_until: NonNegativeInt = 15_000
    growth_threshold: NonNegativeFloat = 0.003
    growth_share: Fraction = 0.07
    score_views: PositiveInt = 10
    prune_opacity: Annotated[float, Interval(ge=0, lt=1)] = 1 / 255
    opacity_decay: Annotated[float, Interval(ge=0, lt=1)] = 0.004
    scale_decay: Annotated[float, Interval(ge=0, lt=1)] = 0.002
    decay_until: PositiveInt = 30_000  # iterations; the length of the training
    noise_rate: NonNegativeFloat = 50.0  # times the learning rate of the means
    initial_opacity: OpenFraction = 0.5
    initial_scale: PositiveFloat = 0.1  # of the distance to the neighbours

    def prepare(self, gaussians: Gaussians) -> Gaussians:
        return spread_out(gaussians, self.initial_opacity, self.initial_scale)

    def observe(self, step: int, render: RenderOutput) -> None:
        self.statistics["seen"] |= render.visible

    def rules(self, refinement: Refinement) -> list[Rule]:
        if not self.due(refinement.step):
            return []
        return [self.refill_and_grow, self.decay, self.reset_statistics]

    def refill_and_grow(self, refinement: Refinement) -> None:
        """Prune, split as many Gaussians to replace the pruned ones, then split a share of the candidates."""
        step, rng, event = refinement.step, refinement.rng, refinement.event
        values, seen = refinement.gaussians.values, self.statistics["seen"]
        pruned = self.to_prune(values)  # [N]
        num_pruned = int(pruned.sum())
        views = draw_views(self.context.training_views, self.score_views, rng)
        weights = self.refine_weights(views, values, step)
        edges = edge_scores(self.context.training_views, views, values, step, by_median)
        edge_factor = 1 + EDGE_WEIGHT * by_median(edges)  # [N]
        candidates = (weights > self.growth_threshold) & seen
        wanted = int(self.growth_share * int(candidates.sum()) + 0.5)

        room = (self.allowance(refinement) or 0) + num_pruned
        opacity_scores = values.opacities.detach() * edge_factor
        replacing = draw(seen & ~pruned & (opacity_scores > 0), opacity_scores, min(num_pruned, room), rng)
        remaining = max(0, wanted - int(replacing.sum())) if step < self.grow_until else 0
        eligible = candidates & ~pruned & ~replacing
        growing = draw(eligible, weights * edge_factor, min(remaining, room - int(replacing.sum())), rng)
        event.blocked_by_cap += max(0, min(remaining, int(eligible.sum())) - int(growing.sum()))
        event.pruned_opacity += num_pruned
        event.split_gradient += int((replacing | growing).sum())
        self.split_along(refinement, replacing | growing, ~pruned)

    def refine_weights(self, views: Sequence[int], gaussians: Gaussians, step: int) -> Tensor:
        """The refine weights [N] over the training views at the indices ``views``."""
        training, largest = self.context.training_views, torch.zeros_like(gaussians.opacity_logits)
        for index in views:
            error = training.dissimilarity(index, training.render(index, gaussians, step).image.detach())  # [H, W]
            error = (error / error.mean().clamp_min(torch.finfo(error.dtype).tiny)).unsqueeze(-1)
            sums, _ = blended_sums(training, index, gaussians, step, error.expand(-1, -1, 3).contiguous())
            largest = torch.maximum(largest, sums[:, 0])
        return largest

    def to_prune(self, gaussians: Gaussians) -> Tensor:
        """Mask [N] of the Gaussians to prune: transparent, too small, too large, or too far away."""
        center, half, _ = bounds(gaussians.means.detach())
        limit = REACH * half
        scales = gaussians.log_scales
        far = (gaussians.means - center).abs().amax(-1) > limit
        sizes = (scales.amin(-1) < math.log(MIN_SCALE)) | (scales.amax(-1).exp() > limit)
        return (gaussians.opacities < self.prune_opacity) | sizes | far

    def split_along(self, refinement: Refinement, selected: Tensor, kept: Tensor) -> None:
        """Split the Gaussians at the mask ``selected`` [N] along their longest axis; of the others, keep those at
        ``kept`` [N]."""
        parents = selected.nonzero().squeeze(-1)  # [S]
        parent_values = refinement.gaussians.values.detach().select(parents)
        children = halves(parent_values, SPLIT_OFFSET, SPLIT_LONGEST, SPLIT_ACROSS, SPLIT_OPACITY)
        self.edit(refinement, kept & ~selected, children, parents.repeat(2), Cause.SPLIT_GRADIENT)

    def decay(self, refinement: Refinement) -> None:
        """Lower all opacities and scales a little. Adam's moments stay."""
        values, remaining = refinement.gaussians.values, max(0.0, 1 - refinement.step / self.decay_until)
        opacities = values.opacities - self.opacity_decay * remaining
        margin = max(
            MIN_DECAYED, torch.finfo(opacities.dtype).eps
        )  # in float32, 1 - 1e-12 would be 1: an infinite logit
        values.opacity_logits.copy_(torch.logit(opacities.clamp(MIN_DECAYED, 1 - margin)))
        values.log_scales.add_(math.log(1 - self.scale_decay * remaining)).clamp_min_(math.log(MIN_DECAYED))

    @torch.no_grad()
    def after_step(self, step: int, gaussians: TrainableGaussians, rng: torch.Generator) -> None:
        if step >= self.stop or len(gaussians) == 0:
            return
        values, seen = gaussians.values, self.statistics["seen"]
        _, _, size = bounds(values.means)
        weight = (1 - values.opacities).pow(NOISE_POWER) * (self.noise_rate * gaussians.position_rate)  # [N]
        noise = standard_normal((len(gaussians), 3), rng, values.means) * weight.unsqueeze(-1)
        values.means += torch.where(seen.unsqueeze(-1), noise.clamp(-size, size), 0.0)


def bounds(means: Tensor) -> tuple[Tensor, float, float]:
    """The box between the quantiles `BOUNDS` of ``means`` [N, 3], in world units.

    Returns its centre [3], half its longest edge, and its edge of middle length.
    """
    ordered = means.sort(dim=0).values
    low, high = (ordered[int(share * (len(means) - 1))] for share in BOUNDS)
    edges = (high - low).sort().values
    return (low + high) / 2, float(edges[2]) / 2, float(edges[1])
