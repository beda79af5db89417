"""3DGS-MCMC and MRNF: small growth by random draws, and noise on the means."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

import torch
from annotated_types import Interval
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.base import Refinement, Rule
from gsbench.densify.budget import Budgeted
from gsbench.densify.improved_gs import halves
from gsbench.densify.scores import (
    blended_sums,
    by_median,
    draw,
    draw_views,
    edge_scores,
    standard_normal,
)
from gsbench.events import Cause
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import Fraction, OpenFraction

BINOMIALS = 51  # rows of the authors' table of binomials; their code allows one copy fewer
GATE_STEEPNESS = 100.0  # of the sigmoid that suppresses noise on opaque Gaussians


@dataclass
class SpreadOut(Budgeted):
    """Base of densifiers that start with small Gaussians of one opacity."""

    initial_opacity: OpenFraction = 0.5
    initial_scale: PositiveFloat = 0.1  # of the distance to the neighbours

    def prepare(self, gaussians: Gaussians) -> Gaussians:
        opacity = self.initial_opacity
        logits = torch.full_like(gaussians.opacity_logits, math.log(opacity / (1 - opacity)))
        log_scales = gaussians.log_scales + math.log(self.initial_scale)
        return replace(gaussians, opacity_logits=logits, log_scales=log_scales)


@dataclass
class MCMC(SpreadOut):
    """3DGS-MCMC: each round moves dead Gaussians to living ones and adds copies.

    A dead Gaussian has an opacity of at most ``min_opacity``. A Gaussian and its copies get a
    common opacity and scale, so that the picture stays the same (eq. 9 of the paper). After each
    step, noise is added to the means. The count never exceeds ``max_gaussians``.
    """

    stop: int = 25_000
    max_gaussians: PositiveInt = 1_000_000  # exact
    # hard | governor: the count follows a curve instead of growing by a share
    cap: Literal["hard", "governor"] = "hard"
    growth: NonNegativeFloat = 0.05  # share of the present count that each refinement adds
    min_opacity: OpenFraction = 0.005  # dead at and below it
    noise_rate: NonNegativeFloat = 5e5  # times the learning rate of the means
    opacity_weight: NonNegativeFloat = 0.01  # of the mean opacity, in the loss
    scale_weight: NonNegativeFloat = 0.01  # of the mean scale, in the loss
    # that share opacity, the Gaussian included
    max_copies: Annotated[int, Interval(ge=1, le=BINOMIALS)] = 50

    def regularizer(self, gaussians: Gaussians) -> Tensor:
        opacity, scale = gaussians.opacities.mean(), gaussians.scales.mean()
        return self.opacity_weight * opacity + self.scale_weight * scale

    def rules(self, refinement: Refinement) -> list[Rule]:
        return [*self.governing(), self.relocate, self.add] if self.due(refinement.step) else []

    def forecast(self, refinement: Refinement) -> int:
        """The count after a round without the cap; ``strictness`` divides the growth."""
        return int((1 + self.growth / refinement.strictness) * len(refinement.gaussians))

    def may_cull(self, step: int) -> bool:
        """Return False: dead Gaussians are moved, not pruned."""
        return False

    @torch.no_grad()
    def after_step(self, step: int, gaussians: TrainableGaussians, rng: torch.Generator) -> None:
        values = gaussians.values
        # [N], near 0 if opaque
        gate = torch.sigmoid(-GATE_STEEPNESS * (values.opacities - self.min_opacity))
        noise = standard_normal((len(gaussians), 3), rng, values.means)
        # The covariance R S S R^T times the noise, without a matrix: fewer operations and bytes.
        unit = torch.nn.functional.normalize(values.quaternions, dim=-1)
        w, axis = unit.split([1, 3], dim=-1)
        local = _rotated(-w, axis, noise)  # the inverse rotation
        offsets = _rotated(w, axis, local * values.scales.square())  # [N, 3]
        values.means += offsets * gate.unsqueeze(-1) * (self.noise_rate * gaussians.position_rate)

    def relocate(self, refinement: Refinement) -> None:
        """Replace each dead Gaussian by a copy of a living one, drawn by opacity."""
        gaussians = refinement.gaussians
        dead = gaussians.values.opacities <= self.min_opacity  # [N]
        count = int(dead.sum())
        if count in (0, len(gaussians)):
            return
        opacities = gaussians.values.opacities.masked_fill(dead, 0)
        self._copy(refinement, opacities, count, ~dead, Cause.RELOCATED)
        refinement.event.relocated = count

    def add(self, refinement: Refinement) -> None:
        """Add copies of living Gaussians, drawn by opacity: a share ``growth``, up to the cap."""
        gaussians, event = refinement.gaussians, refinement.event
        if event.relocated == 0 and (gaussians.values.opacities <= self.min_opacity).all():
            return  # all are dead
        wanted = self.forecast(refinement) - len(gaussians)
        event.added = min(wanted, max(0, self.max_gaussians - len(gaussians)))
        event.blocked_by_cap += wanted - event.added
        if event.added == 0:
            return
        self._copy(refinement, gaussians.values.opacities, event.added, None, Cause.ADDED)

    def _copy(
        self, refinement: Refinement, weights: Tensor, count: int, keep: Tensor | None, cause: Cause
    ) -> None:
        """Append ``count`` (at least 1) copies of Gaussians drawn by ``weights`` [N].

        A Gaussian and its copies share its opacity. Gaussians outside the mask ``keep`` [N] are
        removed (None: none are).
        """
        gaussians, sources = refinement.gaussians, _draw(weights, count, refinement.rng)  # [A]
        copies = torch.bincount(sources, minlength=len(gaussians)) + 1  # [N], the Gaussian included
        touched = copies > 1
        limited = copies[touched].clamp_max(self.max_copies)
        opacity, shrink = shared_opacity(gaussians.values.opacities[touched], limited)
        opacity = opacity.clamp(self.min_opacity, 1 - 1e-6)
        logits = gaussians.values.opacity_logits.clone()
        logits[touched] = torch.logit(opacity)
        log_scales = gaussians.values.log_scales.clone()
        log_scales[touched] += shrink.log().unsqueeze(-1)
        changed = {"opacity_logits": logits, "log_scales": log_scales}
        # all six parameters: overwriting zeroes the moments
        for name, tensor in gaussians.values.tensors().items():
            gaussians.overwrite(name, changed.get(name, tensor), where=touched)
        self.edit(refinement, keep, gaussians.values.select(sources), sources, cause)


def _rotated(w: Tensor, axis: Tensor, vectors: Tensor) -> Tensor:
    """``vectors`` [N, 3] rotated by unit quaternions with ``w`` [N, 1] and ``axis`` [N, 3]."""
    twice = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * twice + torch.linalg.cross(axis, twice)


def shared_opacity(opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity o' and scale factor s'/s of n ``copies`` that look like one Gaussian of opacity o.

    o' = 1 - (1 - o)^(1/n) and s'/s = o / sum_{i=1..n} sum_{k=0..i-1} C(i-1, k) (-1)^k o'^(k+1) /
    sqrt(k+1) (eq. 9 of the paper). All tensors are [M].
    """
    new = 1 - (1 - opacities.double()).pow(1 / copies.double())  # [M]
    total = torch.zeros_like(new)
    for i in range(1, int(copies.max()) + 1):
        inner = torch.zeros_like(new)
        for k in range(i):
            inner += math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
        total += torch.where(copies >= i, inner, 0.0)
    return new.to(opacities.dtype), (opacities / total).to(opacities.dtype)


def _draw(weights: Tensor, count: int, rng: torch.Generator) -> Tensor:
    """Draw ``count`` indices with replacement, in proportion to ``weights`` [N].

    The CPU draws, so that a seed gives the same indices on every device.
    """
    cumulative = weights.double().cpu().cumsum(0)
    draws = torch.rand(count, generator=rng, dtype=torch.float64) * cumulative[-1]
    index = torch.searchsorted(cumulative, draws, right=True)
    return index.clamp_max(len(weights) - 1).to(weights.device)


# Constants from LichtFeld-Studio's code (src/training/strategies/mrnf.cpp,
# kernels/mrnf_kernels.cu).
EDGE_WEIGHT = 0.25  # weights of draws are multiplied by 1 + this times (edge score / its median)
REACH = 100.0  # times half the scene's size; Gaussians that are farther or larger are pruned
MIN_SCALE = 1e-10  # world units; smaller Gaussians are pruned
BOUNDS = (0.1, 0.9)  # quantiles of the means on each axis that bound the scene
NOISE_POWER = 150.0  # noise is proportional to (1 - opacity) to this power
SPLIT_OFFSET = 0.5  # standard deviations
# factors on the children's longest scale, their other scales, and their opacity
SPLIT_FACTORS = 0.5, 0.85, 0.6
MIN_DECAYED = 1e-12  # of opacities and scales after decay


@dataclass
class MRNF(SpreadOut):
    """MRNF of LichtFeld Studio: long-axis splits replace pruned Gaussians and add a small share.

    Opacities and scales decay. The refine weight of a Gaussian is the largest sum over pixels of e
    alpha T in ``score_views`` training views, drawn in each round, where e = max(0, 1 - SSIM)
    divided by its mean in the view. Candidates are the Gaussians seen since the last round whose
    weight is above ``growth_threshold``. A round prunes Gaussians below ``prune_opacity`` and those
    too small, too large or too far away. Then it splits:

    1. as many Gaussians as it pruned, drawn by opacity;
    2. until iteration ``grow_until``, further candidates, drawn by refine weight, so that the two
       splits together are the ``growth_share`` of all candidates.

    Both draws also favour Gaussians that cover edges. After each round every opacity decreases by
    ``opacity_decay`` and every scale by the share ``scale_decay``; both amounts fall to 0 at
    iteration ``decay_until``. After each step, the means of faint Gaussians get noise.
    """

    STATISTICS: ClassVar = {"seen": torch.bool}  # since the last round

    start: NonNegativeInt = 0
    stop: int = 25_000
    interval: PositiveInt = 200
    max_gaussians: PositiveInt = 1_000_000  # theirs: 5,000,000
    cap: Literal["hard", "curve"] = "hard"
    grow_until: NonNegativeInt = 15_000  # after it, only pruned Gaussians are replaced
    growth_threshold: NonNegativeFloat = 0.003
    growth_share: Fraction = 0.07  # of the candidates, split in each round
    score_views: PositiveInt = 10  # drawn in each round
    prune_opacity: Annotated[float, Interval(ge=0, lt=1)] = 1 / 255
    # subtracted from every opacity in each round; falls to 0 at decay_until
    opacity_decay: Annotated[float, Interval(ge=0, lt=1)] = 0.004
    # share by which every scale shrinks in each round; falls to 0 at decay_until
    scale_decay: Annotated[float, Interval(ge=0, lt=1)] = 0.002
    decay_until: PositiveInt = 30_000  # iterations; the length of the training
    noise_rate: NonNegativeFloat = 50.0  # times the learning rate of the means

    def observe(self, step: int, render: RenderOutput) -> None:
        self.statistics["seen"] |= render.visible

    def rules(self, refinement: Refinement) -> list[Rule]:
        if not self.due(refinement.step):
            return []
        return [self.refill_and_grow, self.decay, self.reset_statistics]

    def refill_and_grow(self, refinement: Refinement) -> None:
        """Prune, split as many to replace them, then split a share of the candidates."""
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

        free = (self.allowance(refinement) or 0) + num_pruned
        opacity_scores = values.opacities * edge_factor
        replacing = draw(seen & ~pruned, opacity_scores, num_pruned, rng)
        remaining = max(0, wanted - int(replacing.sum())) if step < self.grow_until else 0
        eligible = candidates & ~pruned & ~replacing
        allowed = min(remaining, free - int(replacing.sum()))
        growing = draw(eligible, weights * edge_factor, allowed, rng)
        event.blocked_by_cap += max(0, min(remaining, int(eligible.sum())) - int(growing.sum()))
        event.pruned_opacity += num_pruned
        parents = (replacing | growing).nonzero().squeeze(-1)  # [S]
        event.split_gradient += len(parents)
        children = halves(values.select(parents), SPLIT_OFFSET, *SPLIT_FACTORS)
        kept = ~(pruned | replacing | growing)
        self.edit(refinement, kept, children, parents.repeat(2), Cause.SPLIT_GRADIENT)

    def refine_weights(self, views: Sequence[int], gaussians: Gaussians, step: int) -> Tensor:
        """The refine weights [N] over the training views at the indices ``views``."""
        training, largest = self.context.training_views, torch.zeros_like(gaussians.opacity_logits)
        for index in views:
            image = training.render(index, gaussians, step).image
            error = training.dissimilarity(index, image)  # [H, W]
            error = error / error.mean().clamp_min(torch.finfo(error.dtype).tiny)
            weights = error.unsqueeze(-1).expand(-1, -1, 3).contiguous()
            sums, _ = blended_sums(training, index, gaussians, step, weights)
            largest = torch.maximum(largest, sums[:, 0])
        return largest

    def to_prune(self, gaussians: Gaussians) -> Tensor:
        """Mask [N] of the Gaussians that are transparent, too small, too large, or too far away."""
        center, half, _ = bounds(gaussians.means.detach())
        limit = REACH * half
        scales = gaussians.log_scales
        far = (gaussians.means - center).abs().amax(-1) > limit
        sizes = (scales.amin(-1) < math.log(MIN_SCALE)) | (scales.amax(-1).exp() > limit)
        return (gaussians.opacities < self.prune_opacity) | sizes | far

    def decay(self, refinement: Refinement) -> None:
        """Lower all opacities and scales a little; Adam's moments do not change."""
        values = refinement.gaussians.values
        remaining = max(0.0, 1 - refinement.step / self.decay_until)
        opacities = values.opacities - self.opacity_decay * remaining
        # in float32, 1 - 1e-12 would be 1: an infinite logit
        margin = max(MIN_DECAYED, torch.finfo(opacities.dtype).eps)
        values.opacity_logits.copy_(torch.logit(opacities.clamp(MIN_DECAYED, 1 - margin)))
        shrink = math.log(1 - self.scale_decay * remaining)
        values.log_scales.add_(shrink).clamp_min_(math.log(MIN_DECAYED))

    @torch.no_grad()
    def after_step(self, step: int, gaussians: TrainableGaussians, rng: torch.Generator) -> None:
        if step >= self.stop or len(gaussians) == 0:
            return
        values, seen = gaussians.values, self.statistics["seen"]
        _, _, size = bounds(values.means)
        rate = self.noise_rate * gaussians.position_rate
        weight = (1 - values.opacities).pow(NOISE_POWER) * rate  # [N]
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
