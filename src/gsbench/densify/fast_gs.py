"""FastGS: growth and pruning by the number of badly rendered pixels that a Gaussian covers in several views."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.absgs import AbsGS
from gsbench.densify.base import Refinement, Rule
from gsbench.densify.scores import draw, draw_views, error_map, to_unit_range
from gsbench.gaussians.model import Gaussians
from gsbench.settings import Fraction, OpenFraction

MIN_DIVISOR = 1e-6  # keeps the weights finite by which Gaussians are drawn for pruning (from the authors' code)


@dataclass
class FastGS(AbsGS):
    """AbsGS whose candidates grow only if they cover badly rendered pixels (Ren et al., arXiv 2511.04283).

    Each round draws ``score_views`` training views. A pixel is bad if its L1 error, shifted and scaled to [0, 1] in
    its view, is above ``error_threshold``. A Gaussian's count is the number of bad pixels that it is blended into. A
    candidate grows if its mean count over the views, rounded down, is above ``least_count``.

    The pruning score is the sum over views of the view's loss times the count, shifted and scaled to [0, 1]. If n
    Gaussians are faint or huge, n / 2 are drawn from all Gaussians in proportion to 1 / (1 - score); faint and huge
    Gaussians are pruned only if drawn. Then opacities are lowered to the ceiling. After the window, every
    ``final_interval`` iterations, Gaussians below ``final_opacity`` or above ``final_score`` are pruned.
    """

    STATISTICS: ClassVar[dict[str, torch.dtype]] = {"count": torch.float32, "score": torch.float32}  # within a round
    needs_footprint = True

    split_threshold: PositiveFloat = 1.2e-3
    cap: Literal["soft", "hard", "curve"] = "soft"  # freeze and governor need a forecast before there are scores
    score_views: PositiveInt = 10
    error_threshold: Fraction = 0.1
    least_count: NonNegativeFloat = 5.0
    final_interval: PositiveInt = 3000
    final_opacity: OpenFraction = 0.1
    final_score: Fraction = 0.9

    def rules(self, refinement: Refinement) -> list[Rule]:
        """The rules of ADC, with scores before growth and the ceiling after pruning; then the final prunings."""
        step = refinement.step
        rules = [rule for rule in super().rules(refinement) if rule != self.lower_opacity]
        if self.grow_by_gradient in rules:
            rules.insert(rules.index(self.grow_by_gradient), self.score)
            rules.insert(rules.index(self.prune) + 1, self.lower_opacity)
        if step > self.stop and step % self.final_interval == 0:
            rules += [self.score, self.prune_finally, self.reset_statistics]
        return rules

    def score(self, refinement: Refinement) -> None:
        """Compute the count and the pruning score of every Gaussian."""
        values, views = refinement.gaussians.values, self.context.training_views
        indices = draw_views(views, self.score_views, refinement.rng)
        total, weighted = torch.zeros_like(values.opacity_logits), torch.zeros_like(values.opacity_logits)
        for index in indices:
            counts, loss = self.bad_pixels(index, values, refinement.step)
            total += counts
            weighted += loss * counts
        self.statistics["count"] = (total / len(indices)).floor().float()
        self.statistics["score"] = to_unit_range(weighted).float()

    def bad_pixels(self, index: int, gaussians: Gaussians, step: int) -> tuple[Tensor, Tensor]:
        """The number [N] of bad pixels of a view that each Gaussian is blended into, and the loss of the view."""
        views = self.context.training_views
        render = views.render(index, gaussians, step)
        bad = error_map(render.image, views.image(index)) > self.error_threshold
        return render.require_footprint(bad.to(render.image)).values, views.loss(index, render.image)

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        over, large = super().candidates(refinement)
        return over & (self.statistics["count"] > self.least_count), large

    def prune(self, refinement: Refinement) -> None:
        """Remove some of the faint and huge Gaussians, more likely those with high scores."""
        values, score = refinement.gaussians.values, self.statistics["score"]
        faint, huge = self.faint(values.opacity_logits), self.huge(refinement.step, values.log_scales)
        # Only Gaussians from before the round have a score. They come first, without the removed split parents.
        split_parents = refinement.event.split_gradient // (self.split_children - 1)
        scored = torch.arange(len(score), device=score.device) < refinement.event.before - split_parents
        drawn = draw(scored, 1 / (MIN_DIVISOR + 1 - score), int((faint | huge).sum()) // 2, refinement.rng)
        self.remove(refinement, faint & drawn, huge & drawn)

    def prune_finally(self, refinement: Refinement) -> None:
        """Remove Gaussians below ``final_opacity`` or above ``final_score``."""
        faint = refinement.gaussians.values.opacities < self.final_opacity  # [N]
        self.remove(refinement, faint, self.statistics["score"] > self.final_score)
