"""FastGS and Taming 3DGS: scores over several training views decide about growth and pruning."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.adc import ADC
from gsbench.densify.adc_variants import AbsGS
from gsbench.densify.base import Refinement, Rule
from gsbench.densify.scores import (
    blended_sums,
    by_median,
    draw,
    draw_views,
    edge_map,
    error_map,
    to_unit_range,
)
from gsbench.gaussians.model import Gaussians
from gsbench.settings import Fraction, OpenFraction

# keeps the weights of draws for pruning finite (from the authors' code of both)
MIN_DIVISOR = 1e-6


@dataclass
class FastGS(AbsGS):
    """AbsGS that grows only on badly rendered pixels (Ren et al., arXiv 2511.04283).

    Each round draws ``score_views`` training views. A pixel is bad if its L1 error, shifted and
    scaled to [0, 1] in its view, is above ``error_threshold``. A Gaussian's count is the number of
    bad pixels that it is blended into. A candidate grows if its mean count over the views, rounded
    down, is above ``least_count``.

    The pruning score is the sum over views of the view's loss times the count, shifted and scaled
    to [0, 1]. If n Gaussians are faint or huge, n / 2 are drawn from all Gaussians in proportion to
    1 / (1 - score); faint and huge Gaussians are pruned only if drawn. Then opacities are lowered
    to the ceiling. After the window, every ``final_interval`` iterations, Gaussians below
    ``final_opacity`` or above ``final_score`` are pruned.
    """

    # computed and used within one round
    STATISTICS: ClassVar = {"count": torch.float32, "score": torch.float32}
    needs_footprint = True

    split_threshold: PositiveFloat = 1.2e-3  # of splits, by the absolute gradient
    # freeze and governor need a forecast before there are scores
    cap: Literal["soft", "hard", "curve"] = "soft"
    score_views: PositiveInt = 10  # drawn in each round
    error_threshold: Fraction = 0.1  # a pixel is bad if its L1 error, scaled to [0, 1], is above it
    least_count: NonNegativeFloat = 5.0  # a candidate grows if it covers more bad pixels per view
    final_interval: PositiveInt = 3000  # after the window
    final_opacity: OpenFraction = 0.1
    final_score: Fraction = 0.9

    def round_at(self, step: int) -> list[Rule]:
        """The rules of ADC, with scores before growth and the ceiling after pruning."""
        grow, prune, reset = super().round_at(step)
        return [self.score, grow, prune, self.lower_opacity, reset]

    def rules(self, refinement: Refinement) -> list[Rule]:
        """The rules of ADC; after the window, the final prunings."""
        step = refinement.step
        rules = super(AbsGS, self).rules(refinement)  # its ceiling comes in each round here
        if step > self.stop and step % self.final_interval == 0:
            rules += [self.score, self.prune_finally, self.reset_statistics]
        return rules

    def score(self, refinement: Refinement) -> None:
        """Compute the count and the pruning score of every Gaussian."""
        values, views = refinement.gaussians.values, self.context.training_views
        indices = draw_views(views, self.score_views, refinement.rng)
        total = torch.zeros_like(values.opacity_logits)
        weighted = torch.zeros_like(values.opacity_logits)
        for index in indices:
            render = views.render(index, values, refinement.step)
            bad = error_map(render.image, views.image(index)) > self.error_threshold
            # [N] number of bad pixels that each Gaussian is blended into
            counts = render.require_footprint(bad.to(render.image)).values
            total += counts
            weighted += views.loss(index, render.image) * counts
        self.statistics["count"] = (total / len(indices)).floor().float()
        self.statistics["score"] = to_unit_range(weighted).float()

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        over, large = super().candidates(refinement)
        return over & (self.statistics["count"] > self.least_count), large

    def prune(self, refinement: Refinement) -> None:
        """Remove some of the faint and huge Gaussians, more likely those with high scores."""
        score, event = self.statistics["score"], refinement.event
        # Only Gaussians from before the round have a score. They come first, without the removed
        # split parents.
        known = event.before - event.split_gradient // (self.split_children - 1)
        scored = torch.arange(len(score), device=score.device) < known
        self.prune_drawn(refinement, scored, 1 / (MIN_DIVISOR + 1 - score))

    def prune_finally(self, refinement: Refinement) -> None:
        """Remove Gaussians below ``final_opacity`` or above ``final_score``."""
        faint = refinement.gaussians.values.opacities < self.final_opacity  # [N]
        self.remove(refinement, faint, self.statistics["score"] > self.final_score)


@dataclass
class Taming(ADC):
    """ADC whose candidates are drawn by score, up to a budget (Mallick et al., arXiv 2406.15643).

    Each round draws ``score_views`` training views. A view that sees a Gaussian adds to its score
    the loss of the view times a weighted sum of the terms below (``weight_…``), each divided by its
    median. A pixel's value, which some terms use, is ``weight_error`` times its L1 error plus
    ``weight_edge`` times its edge strength, both in [0, 1].

    A round may grow to the count that ``cap=curve`` allows (eq. 2 of the paper). This budget is
    divided between clones and splits in proportion to the numbers of their candidates, which are
    drawn without replacement in proportion to the score. In the first ``prune_rounds`` rounds, if n
    Gaussians are faint or huge, n / 2 are drawn from all Gaussians in inverse proportion to the
    score; faint and huge Gaussians are pruned only if drawn.
    """

    # score of this round; 0 for new Gaussians
    STATISTICS: ClassVar = {"score": torch.float32}
    needs_footprint = True

    max_gaussians: PositiveInt = 1_000_000  # the budget
    cap: Literal["curve", "hard"] = "curve"
    score_views: PositiveInt = 10  # drawn in each round
    prune_rounds: PositiveInt = 27  # only this many first rounds prune
    weight_gradient: NonNegativeFloat = 25.0  # mean gradient since the last round
    weight_opacity: NonNegativeFloat = 100.0
    weight_depth: NonNegativeFloat = 5.0  # view z
    weight_radius: NonNegativeFloat = 10.0  # px
    weight_scale: NonNegativeFloat = 25.0  # product of the three scales
    # sum over the Gaussian's pixels of their distance to its mean
    weight_distance: NonNegativeFloat = 50.0
    weight_values: NonNegativeFloat = 10.0  # sum over its pixels of their values
    weight_pixels: NonNegativeFloat = 0.1  # number of its pixels
    weight_blending: NonNegativeFloat = 50.0  # sum over its pixels of alpha T
    weight_error: NonNegativeFloat = 50.0  # of the L1 error in a pixel's value
    weight_edge: NonNegativeFloat = 50.0  # of the edge strength in a pixel's value

    def round_at(self, step: int) -> list[Rule]:
        """The rules of ADC, with scores before growth."""
        return [self.score, *super().round_at(step)]

    def score(self, refinement: Refinement) -> None:
        """Compute the score of every Gaussian, as a statistic that the round's edits maintain."""
        values, rng = refinement.gaussians.values, refinement.rng
        views, total = self.context.training_views, torch.zeros_like(values.opacity_logits)
        for index in draw_views(views, self.score_views, rng):
            total += self.score_in(index, values, refinement.step)
        self.statistics["score"] = (total + MIN_DIVISOR).float()

    def score_in(self, index: int, gaussians: Gaussians, step: int) -> Tensor:
        """The score [N] that training view ``index`` adds."""
        views = self.context.training_views
        photograph = views.image(index)
        image = views.render(index, gaussians, step).image
        error = error_map(image, photograph)
        pixels = self.weight_error * error + self.weight_edge * edge_map(photograph).to(error)
        sums, render = blended_sums(views, index, gaussians, step, torch.ones_like(image))
        footprint, visible = render.require_footprint(pixels), render.visible
        terms = (
            (self.weight_gradient, self.mean_gradient()),
            (self.weight_opacity, gaussians.opacities),
            (self.weight_depth, torch.where(visible, footprint.depths, 0.0)),
            (self.weight_radius, render.radii.to(error)),
            (self.weight_scale, gaussians.scales.prod(-1)),
            (self.weight_distance, footprint.distances),
            (self.weight_values, footprint.values),
            (self.weight_pixels, footprint.pixels.to(error)),
            (self.weight_blending, sums[:, 0]),
        )
        total = torch.stack([weight * by_median(term) for weight, term in terms]).sum(0)  # [N]
        return torch.where(visible, views.loss(index, image) * total, 0.0)

    def choose(self, refinement: Refinement, candidates: Tensor, gain: int) -> tuple[Tensor, int]:
        _, large = self.candidates(refinement)
        count, allowed = int(candidates.sum()), self.allowance(refinement)
        assert allowed is not None  # every cap of this class has a limit
        num_drawn = min(allowed // gain, count)
        drawn = torch.zeros_like(candidates)
        for group in (candidates & ~large, candidates & large):
            share = num_drawn * int(group.sum()) // max(count, 1)
            drawn |= draw(group, self.statistics["score"], share, refinement.rng)
        return drawn, count - int(drawn.sum())

    def prune(self, refinement: Refinement) -> None:
        """Remove some of the faint and huge Gaussians, more likely those with low scores."""
        if refinement.step // self.interval - self.start // self.interval > self.prune_rounds:
            return
        score = self.statistics["score"]
        self.prune_drawn(refinement, score > 0, 1 / score)
