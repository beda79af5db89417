"""3DGS as Markov chain Monte Carlo (Kheradmand et al., arXiv 2404.09591): relocation, addition and noise."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import torch
from annotated_types import Interval
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.base import Refinement, Rule
from gsbench.densify.budget import Budgeted
from gsbench.densify.operations import standard_normal
from gsbench.events import Cause
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.settings import OpenFraction, Switch

BINOMIALS = 51  # rows of the authors' table of binomials; their code allows one copy fewer
GATE_STEEPNESS = 100.0  # of the sigmoid that suppresses noise on opaque Gaussians


@dataclass
class MCMC(Budgeted):
    """Each refinement moves dead Gaussians onto living ones and adds a few copies, up to ``max_gaussians``.

    A dead Gaussian has an opacity of at most ``min_opacity``. A Gaussian and its copies get a common opacity and scale,
    so that the picture stays the same (eq. 9 of the paper). After each step, means get noise. The cap is always exact.
    """

    SWITCHES: ClassVar[Mapping[str, Switch]] = {
        "noise": Switch({"noise_rate": 0.0}, "noise on the means"),
        "opacity_term": Switch({"opacity_weight": 0.0}, "the opacities' term of the loss"),
        "scale_term": Switch({"scale_weight": 0.0}, "the scales' term of the loss"),
    }

    stop: int = 25_000
    max_gaussians: PositiveInt = 1_000_000
    cap: Literal["hard", "governor"] = "hard"
    growth: NonNegativeFloat = 0.05  # share of the present count that each refinement adds
    min_opacity: OpenFraction = 0.005  # dead at and below it
    noise_rate: NonNegativeFloat = 5e5  # times the learning rate of the means
    opacity_weight: NonNegativeFloat = 0.01  # of the mean opacity, in the loss
    scale_weight: NonNegativeFloat = 0.01  # of the mean scale, in the loss
    initial_opacity: OpenFraction = 0.5
    initial_scale: PositiveFloat = 0.1  # of the distance to the neighbours
    max_copies: Annotated[int, Interval(ge=1, le=BINOMIALS)] = 50  # that share opacity, the Gaussian included

    def prepare(self, gaussians: Gaussians) -> Gaussians:
        return spread_out(gaussians, self.initial_opacity, self.initial_scale)

    def regularizer(self, gaussians: Gaussians) -> Tensor:
        return self.opacity_weight * gaussians.opacities.mean() + self.scale_weight * gaussians.scales.mean()

    def rules(self, refinement: Refinement) -> list[Rule]:
        return [*self.governing(), self.relocate, self.add] if self.due(refinement.step) else []

    def forecast(self, refinement: Refinement) -> int:
        """The count after a round without the cap: ``strictness`` divides the share that is added."""
        return int((1 + self.growth / self.strictness) * len(refinement.gaussians))

    def may_cull(self, step: int) -> bool:
        """Return False: dead Gaussians are moved, not pruned."""
        return False

    @torch.no_grad()
    def after_step(self, step: int, gaussians: TrainableGaussians, rng: torch.Generator) -> None:
        values = gaussians.values
        gate = torch.sigmoid(-GATE_STEEPNESS * (values.opacities - self.min_opacity))  # [N], near 0 if opaque
        noise = standard_normal((len(gaussians), 3), rng, values.means)
        axes = values.rotations * values.scales.unsqueeze(-2)  # [N, 3, 3]
        covariance = axes @ axes.mT
        offsets = (covariance @ noise.unsqueeze(-1)).squeeze(-1)  # [N, 3]
        values.means += offsets * gate.unsqueeze(-1) * (self.noise_rate * gaussians.position_rate)

    def relocate(self, refinement: Refinement) -> None:
        """Replace each dead Gaussian by a copy of a living one, drawn by opacity."""
        gaussians = refinement.gaussians
        dead = gaussians.values.opacities <= self.min_opacity  # [N]
        count = int(dead.sum())
        if count in (0, len(gaussians)):
            return
        opacities = gaussians.values.opacities.detach().masked_fill(dead, 0)
        sources = _draw(opacities, count, refinement.rng)  # [D]
        self._share_opacity(gaussians, sources)
        copies = gaussians.values.detach().select(sources)
        self.edit(refinement, keep=~dead, append=copies, parents=sources, cause=Cause.RELOCATED)
        refinement.event.relocated = count

    def add(self, refinement: Refinement) -> None:
        """Add copies of living Gaussians, drawn by opacity: a share ``growth`` of the count, up to the cap."""
        gaussians, event = refinement.gaussians, refinement.event
        if event.relocated == 0 and (gaussians.values.opacities <= self.min_opacity).all():
            return  # all are dead
        wanted = self.forecast(refinement) - len(gaussians)
        event.added = min(wanted, max(0, self.max_gaussians - len(gaussians)))
        event.blocked_by_cap += wanted - event.added
        if event.added == 0:
            return
        sources = _draw(gaussians.values.opacities.detach(), event.added, refinement.rng)  # [A]
        self._share_opacity(gaussians, sources)
        copies = gaussians.values.detach().select(sources)
        self.edit(refinement, append=copies, parents=sources, cause=Cause.ADDED)

    def _share_opacity(self, gaussians: TrainableGaussians, sources: Tensor) -> None:
        """Set opacity and scale of the Gaussians at ``sources`` [D] to those that they share with their copies."""
        copies = torch.bincount(sources, minlength=len(gaussians)) + 1  # [N], the Gaussian included
        touched = copies > 1
        limited = copies[touched].clamp_max(self.max_copies)
        opacity, shrink = shared_opacity(gaussians.values.opacities.detach()[touched], limited)
        opacity = opacity.clamp(self.min_opacity, 1 - 1e-6)
        logits = gaussians.values.opacity_logits.detach().clone()
        logits[touched] = torch.logit(opacity)
        log_scales = gaussians.values.log_scales.detach().clone()
        log_scales[touched] += shrink.log().unsqueeze(-1)
        changed = {"opacity_logits": logits, "log_scales": log_scales}
        for name, tensor in gaussians.values.tensors().items():  # all six parameters: overwriting zeroes the moments
            gaussians.overwrite(name, changed.get(name, tensor), where=touched)


def shared_opacity(opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity o' and factor s'/s on the scale of each of n = ``copies`` that together look like one Gaussian of
    opacity o.

    o' = 1 - (1 - o)^(1/n) and s'/s = o / sum_{i=1..n} sum_{k=0..i-1} C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1), eq. 9 of
    the paper; all [M].
    """
    new = 1 - (1 - opacities.double()).pow(1 / copies.double())  # [M]
    total = torch.zeros_like(new)
    for i in range(1, int(copies.max()) + 1 if len(copies) else 1):
        inner = torch.zeros_like(new)
        for k in range(i):
            inner += math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
        total += torch.where(copies >= i, inner, 0.0)
    return new.to(opacities.dtype), (opacities / total).to(opacities.dtype)


def _draw(weights: Tensor, count: int, rng: torch.Generator) -> Tensor:
    """Draw ``count`` indices with replacement, in proportion to ``weights`` [N]; on the CPU, so that a seed gives the
    same draw on every device."""
    cumulative = weights.double().cpu().cumsum(0)
    draws = torch.rand(count, generator=rng, dtype=torch.float64) * cumulative[-1]
    return torch.searchsorted(cumulative, draws, right=True).clamp_max(len(weights) - 1).to(weights.device)


def spread_out(gaussians: Gaussians, opacity: float, scale: float) -> Gaussians:
    """``gaussians`` with the same ``opacity`` for all, and their scales multiplied by ``scale``."""
    changed = {
        "opacity_logits": torch.full_like(gaussians.opacity_logits, math.log(opacity / (1 - opacity))),
        "log_scales": gaussians.log_scales + math.log(scale),
    }
    return Gaussians(**(gaussians.tensors() | changed))
