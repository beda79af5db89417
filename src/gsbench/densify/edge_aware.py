"""Improved-GS: candidates are drawn by the edges that they cover, and split along their longest axis."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.base import Refinement, Rule
from gsbench.densify.budget import allowance
from gsbench.densify.long_axis import LongAxis
from gsbench.densify.operations import quantile
from gsbench.densify.scores import by_mean, draw, draw_views, edge_scores
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import Fraction, OpenFraction, Switch

# The authors' code has iterations: a round every 100, an opacity reset every 3,000. These are rounds and resets.
CLOSING_ROUNDS = 5  # the last rounds of the window: cap=root has reached its budget, and the score is the gradient
CLOSING_FACTOR = 1.5  # divides the threshold in the closing rounds, while there is room below the cap
EARLY_PRUNE = 3  # rounds after the start of training: faint Gaussians are pruned for the first time
RECOVERY = 3  # rounds after an opacity reset: Gaussians that have recovered least are pruned
ALL_VIEWS = 4  # rounds after an opacity reset: scores use all views
RESETS = 3  # RECOVERY and ALL_VIEWS apply until this opacity reset


@dataclass
class EdgeAware(LongAxis):
    """The long-axis split, of candidates drawn by the edge-aware score of Deng et al. (arXiv 2508.12313).

    Each round draws ``score_views`` training views. The score of a Gaussian in a view is the sum over pixels of (edge
    strength of the photograph) alpha T, divided by the mean of this sum over the Gaussians; the scores of all views are
    averaged. In the closing rounds the score is the mean gradient. Gaussians above the gradient threshold with a
    positive score are drawn without replacement in proportion to it, as many as the cap admits.

    ``cap=root`` is the authors' growth control: a limit of ``max_gaussians`` sqrt(x), where x is the progress of the
    window up to the closing rounds. Faint Gaussians are pruned in each round but the last, huge ones never. Gaussians
    below ``early_prune_opacity`` are pruned once early, and the ``recovery_share`` with the lowest opacities three
    rounds after an opacity reset. Gradients are gathered only within the window.
    """

    SWITCHES: ClassVar[Mapping[str, Switch]] = {
        "absolute_gradient": Switch({"gradient": "signed"}, "the absolute gradient, in which pixels do not cancel"),
        "fading": Switch({"opacity_factor": 1.0}, "children fainter than their parent"),
        "early_prune": Switch({"early_prune_opacity": 0.0}, "the pruning of the faint before the first round"),
        "recovery_prune": Switch({"recovery_share": 0.0}, "the pruning of what did not recover from an opacity reset"),
    }

    gradient: Literal["signed", "absolute"] = "absolute"
    gradient_threshold: PositiveFloat = 3e-4
    score_views: PositiveInt = 10
    cap: Literal["root", "curve", "hard"] = "root"  # type: ignore[assignment]
    max_gaussians: PositiveInt = 1_000_000
    opacity_reset_value: OpenFraction = 0.05
    early_prune_opacity: Fraction = 0.02
    recovery_share: Fraction = 0.2

    def observe(self, step: int, render: RenderOutput) -> None:
        if step > self.start:
            super().observe(step, render)

    def rules(self, refinement: Refinement) -> list[Rule]:
        """The rules of ADC and the additional prunings."""
        step, rules = refinement.step, super().rules(refinement)
        if self.prune in rules and step >= self.stop - self.interval:
            rules.remove(self.prune)
        if step == EARLY_PRUNE * self.interval:
            rules.append(self.prune_early)
        if self.start < step < self.stop and self.rounds_after_reset(step) == RECOVERY:
            rules += [self.prune_unrecovered, self.reset_statistics]
        return rules

    def rounds_after_reset(self, step: int) -> float:
        """Rounds since the last opacity reset (or the start of training); infinity from the last counted reset on."""
        if step >= RESETS * self.opacity_reset_interval:
            return math.inf
        return step % self.opacity_reset_interval / self.interval

    def closing(self, step: int) -> bool:
        """Return whether ``step`` is in the closing rounds."""
        return step > self.stop - CLOSING_ROUNDS * self.interval

    def allowance(self, refinement: Refinement) -> int | None:
        if self.cap != "root":
            return super().allowance(refinement)
        ramp = max(self.stop - CLOSING_ROUNDS * self.interval - self.start, self.interval)
        progress = min((refinement.step - self.start) / ramp, 1.0)
        return allowance(len(refinement.gaussians), int(self.most_gaussians * math.sqrt(progress)), "hard")

    @property
    def most_gaussians(self) -> int:
        return self.max_gaussians

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        over, large = super().candidates(refinement)
        if self.closing(refinement.step) and self.allowance(refinement) != 0:
            over = self.reaches(self.mean_gradient(), self.gradient_threshold / CLOSING_FACTOR)
        return over, large

    def choose(self, refinement: Refinement, candidates: Tensor, gain: int) -> tuple[Tensor, int]:
        count, allowed = int(candidates.sum()), self.allowance(refinement)
        assert allowed is not None  # every cap of this class has a limit
        if count == 0 or allowed == 0:
            return torch.zeros_like(candidates), count
        scores = self.scores(refinement.gaussians.values, refinement.step, refinement.rng)
        chosen = draw(candidates & (scores > 0), scores, allowed, refinement.rng)
        return chosen, count - int(chosen.sum())

    def scores(self, gaussians: Gaussians, step: int, rng: torch.Generator) -> Tensor:
        """Scores [N] by which candidates are drawn."""
        if self.closing(step):
            return self.mean_gradient()
        views = self.context.training_views
        count = len(views) if self.rounds_after_reset(step) == ALL_VIEWS else self.score_views
        return edge_scores(views, draw_views(views, count, rng), gaussians, step, by_mean)

    def huge(self, step: int, log_scales: Tensor) -> Tensor:
        """An empty mask [N]: the authors do not prune by size."""
        return torch.zeros_like(log_scales[:, 0], dtype=torch.bool)

    def prune_early(self, refinement: Refinement) -> None:
        """Remove Gaussians that became faint before the first round."""
        self.prune_below(refinement, self.early_prune_opacity)

    def prune_unrecovered(self, refinement: Refinement) -> None:
        """Remove the ``recovery_share`` with the lowest opacities, which did not recover from the opacity reset."""
        opacities = refinement.gaussians.values.opacities.detach()
        if len(opacities):
            self.prune_below(refinement, quantile(opacities.sort().values, self.recovery_share))

    def prune_below(self, refinement: Refinement, opacity: float) -> None:
        self.remove(refinement, refinement.gaussians.values.opacities < opacity)
