"""Improved-GS and GNS: candidates drawn by edges are split along their longest axis."""

import logging
import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Interval
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.adc import ADC, Grown
from gsbench.densify.base import DensifyContext, Refinement, Rule
from gsbench.densify.scores import by_mean, draw, draw_views, edge_scores, faded, quantile
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import Fraction, OpenFraction

log = logging.getLogger(__name__)

REACH = 3.0  # the assumed extent of a Gaussian, in standard deviations


@dataclass
class LongAxis(ADC):
    """ADC that splits all candidates along their longest axis (Deng et al., arXiv 2508.12313).

    No Gaussian is cloned. With d = ``split_distance`` and s the longest semi-axis, two children
    replace the parent. They lie at 3 d s on either side of it along that axis. Their longest
    semi-axis is (1 - d) s, their other axes are the parent's times sqrt(1 - d^2), and their opacity
    is the parent's times ``opacity_factor``. The split is not random. The options ``split_size``,
    ``split_children``, ``split_shrink`` and ``revised_opacity`` of ADC have no effect.
    """

    gradient: Literal["signed", "absolute"] = "absolute"
    gradient_threshold: PositiveFloat = 8e-4
    # d, in units of 3 sigma, along the longest axis; its scale is multiplied by 1 - d, the others
    # by sqrt(1 - d^2)
    split_distance: OpenFraction = 0.45
    opacity_factor: Annotated[float, Interval(gt=0, le=1)] = 0.6  # of the children

    def grown(self, refinement: Refinement) -> Grown:
        values = refinement.gaussians.values
        over, _ = self.candidates(refinement)
        log_scales = shrunk(values.log_scales, *self._factors)
        return Grown.halved(values, over, log_scales, self.opacity_factor)

    def grow_by_gradient(self, refinement: Refinement) -> None:
        """Split the Gaussians whose mean gradient reaches the threshold."""
        over, _ = self.candidates(refinement)
        selected, blocked = self.choose(refinement, over, 1)
        parents = refinement.gaussians.values.select(selected)
        offset = REACH * self.split_distance
        children = halves(parents, offset, *self._factors, self.opacity_factor)
        self.split_in_halves(refinement, selected, children)
        refinement.event.blocked_by_cap += blocked

    @property
    def _factors(self) -> tuple[float, float]:
        """Factors on the scale of the longest axis and on those of the other two."""
        return 1 - self.split_distance, math.sqrt(1 - self.split_distance**2)


def halves(
    parents: Gaussians, offset: float, longest: float, across: float, opacity: float
) -> Gaussians:
    """Make two children [2 S] of each of ``parents`` [S], one on either side.

    All children on one side come first. They are ``offset`` standard deviations from the parent
    along its longest axis. ``longest`` multiplies the scale of that axis, ``across`` the other
    scales, and ``opacity`` the opacity.
    """
    axis = parents.log_scales.argmax(-1)  # [S]
    directions = parents.rotations[torch.arange(len(axis), device=axis.device), :, axis]  # [S, 3]
    offsets = offset * parents.scales.amax(-1, keepdim=True) * directions
    children = Gaussians.concatenate([parents, parents])
    children.means = torch.cat([parents.means + offsets, parents.means - offsets])
    children.log_scales = shrunk(children.log_scales, longest, across)
    children.opacity_logits = faded(children.opacity_logits, opacity)
    return children


def shrunk(log_scales: Tensor, longest: float, across: float) -> Tensor:
    """Multiply the scale of the longest axis by ``longest`` and the other two by ``across``.

    Takes and returns the logarithms of the scales, [N, 3].
    """
    index = log_scales.argmax(-1, keepdim=True)
    is_longest = torch.zeros_like(log_scales, dtype=torch.bool).scatter(-1, index, True)
    # torch.where with two Python numbers would compute in float32; a tensor keeps float64.
    factors = log_scales.new_tensor([math.log(across), math.log(longest)])
    return log_scales + factors[is_longest.long()]


# The authors' code counts iterations: a round every 100, an opacity reset every 3,000. The
# constants here count rounds and resets.
# the last rounds of the window: cap=root has reached its budget, and the score is the gradient
CLOSING_ROUNDS = 5
# divides the threshold in the closing rounds, while there is room below the cap
CLOSING_FACTOR = 1.5
EARLY_PRUNE = 3  # rounds after the start of training: faint Gaussians are pruned for the first time
RECOVERY = 3  # rounds after an opacity reset: Gaussians that have recovered least are pruned
ALL_VIEWS = 4  # rounds after an opacity reset: scores use all views
RESETS = 3  # RECOVERY and ALL_VIEWS apply until this opacity reset


@dataclass
class EdgeAware(LongAxis):
    """Long-axis splits of candidates that are drawn by edges (Deng et al., arXiv 2508.12313).

    Each round draws ``score_views`` training views. The score of a Gaussian in a view is the sum
    over pixels of (edge strength of the photograph) alpha T, divided by the mean of this sum over
    the Gaussians; the scores of all views are averaged. In the closing rounds the score is the mean
    gradient. Gaussians above the gradient threshold with a positive score are drawn without
    replacement in proportion to it, as many as the cap admits.

    ``cap=root`` is the authors' growth control: a limit of ``max_gaussians`` sqrt(x), where x is
    the progress of the window up to the closing rounds. Faint Gaussians are pruned in each round
    but the last, huge ones never. Gaussians below ``early_prune_opacity`` are pruned once, early.
    Three rounds after an opacity reset, the share ``recovery_share`` with the lowest opacities is
    pruned. Gradients are gathered only within the window.
    """

    prunes_by_size = False

    gradient_threshold: PositiveFloat = 3e-4
    score_views: PositiveInt = 10
    cap: Literal["root", "curve", "hard"] = "root"  # type: ignore[assignment]
    max_gaussians: PositiveInt = 1_000_000  # theirs: 3,000,000
    opacity_reset_value: OpenFraction = 0.05
    # below it, pruned at the iteration of the third round; 0: none
    early_prune_opacity: Fraction = 0.02
    # with the lowest opacities, pruned three rounds after an opacity reset; 0: none
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
            rules.append(partial(self.prune_below, opacity=self.early_prune_opacity))
        if self.start < step < self.stop and self.rounds_after_reset(step) == RECOVERY:
            rules += [self.prune_unrecovered, self.reset_statistics]
        return rules

    def rounds_after_reset(self, step: int) -> float:
        """Rounds since the last opacity reset or the start of training.

        It is infinite from the reset number `RESETS` on.
        """
        if step >= RESETS * self.opacity_reset_interval:
            return math.inf
        return step % self.opacity_reset_interval / self.interval

    def closing(self, step: int) -> bool:
        """Return whether ``step`` is in the closing rounds."""
        return step > self.stop - CLOSING_ROUNDS * self.interval

    def limit(self, step: int) -> int | None:
        if self.cap != "root":
            return super().limit(step)
        ramp = max(self.stop - CLOSING_ROUNDS * self.interval - self.start, self.interval)
        return int(self.most_gaussians * math.sqrt(min((step - self.start) / ramp, 1.0)))

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

    def prune_unrecovered(self, refinement: Refinement) -> None:
        """Remove the share ``recovery_share`` of the Gaussians with the lowest opacities.

        Their opacities did not recover from the opacity reset.
        """
        opacities = refinement.gaussians.values.opacities
        if len(opacities):
            self.prune_below(refinement, quantile(opacities.sort().values, self.recovery_share))

    def prune_below(self, refinement: Refinement, opacity: float) -> None:
        self.remove(refinement, refinement.gaussians.values.opacities < opacity)


# From the authors' code, whose pressure acts every 50 iterations from iteration 15,000 to 23,000.
# length of the pressure's first part, in which its term depends on opacity and nothing is pruned
SOFT_SHARE = 1 / 8
# the first aim, as a share of the opacity of the last Gaussian within the budget at the start
FIRST_AIM = 0.8
LOWEST_LOGIT = 20.0  # the pressure drives all opacity logits towards minus this
# smallest divisor in the first part: an opacity of 0.95 weighs 20 times as much as one near 0
MIN_TRANSPARENCY = 0.05
HARD_FACTOR = 3.0  # on the pressure after the first part
# the weight is changed if the opacity is more than BAND from its aim
BAND, WEAKER, STRONGER = 0.1, 0.8, 1.2
CLOSE = 1.05  # times the budget: below this, the excess is removed at once, by a random draw
RATE_FACTOR = 4.0  # on the learning rate of opacities, until `SOFT_SHARE` after the budget is met
SELECTION = ("step", "weight", "aim", "met_at")  # the attributes of `GNS` that checkpoints hold


@dataclass
class GNS(EdgeAware):
    """Improved-GS, then natural selection (Deng et al., arXiv 2511.16980).

    Improved-GS grows up to ``overgrowth`` times the budget ``max_gaussians``. Then a pressure on
    opacities selects Gaussians. It starts at the end of the window and lasts ``pressure_length``
    times the window's length. Every half interval, a term in the loss lowers all opacity logits l
    (opacity o): w (mean of (l + 20) / max(0.05, 1 - o))^2 in the first eighth of that time, then 3
    w (mean l + 20)^2. The photometric loss counteracts it for Gaussians that the pictures need.
    After the first eighth, Gaussians below ``selected_opacity`` are pruned.

    The weight w starts at ``pressure``. It is adjusted so that the opacity of the last Gaussian
    within the budget follows an aim, which falls from 0.8 of its initial value to 0 in seven
    eighths of the time. When the count is within 5 % of the budget, or the time ends, exactly
    ``max_gaussians`` are kept, drawn by opacity. During the pressure, and for an eighth of its time
    after it, the learning rate of opacities is four times as high.

    If the training ends before the pressure does, the final count is above ``max_gaussians``.
    """

    cap: Literal["root"] = "root"  # for the growth; the selection then ends at max_gaussians
    max_gaussians: PositiveInt = 600_000  # final count; before, up to overgrowth times as many
    overgrowth: Annotated[float, Ge(1)] = 3.0
    pressure: PositiveFloat = 2e-4  # initial weight of the term in the loss
    # of the window's length, from the end of the window
    pressure_length: Annotated[float, Interval(gt=0)] = 0.552
    selected_opacity: OpenFraction = 0.001  # lower opacities are pruned under pressure

    def begin(self, gaussians: Gaussians, context: DensifyContext) -> None:
        super().begin(gaussians, context)
        self.step = 0  # last observed iteration
        self.weight = self.pressure
        # initial value of the aimed opacity; None before the pressure
        self.aim: float | None = None
        self.met_at: int | None = None  # iteration at which the budget was met

    @property
    def most_gaussians(self) -> int:
        return int(self.overgrowth * self.max_gaussians)

    @property
    def pressure_interval(self) -> int:
        """Iterations between two terms in the loss."""
        return max(1, self.interval // 2)

    @property
    def pressure_time(self) -> int:
        """Iterations from the end of the window to the end of the pressure."""
        rounds = max(1, round(self.pressure_length * (self.stop - self.start) / self.interval))
        return rounds * self.interval

    def pressing(self, step: int) -> bool:
        """Return whether the pressure acts at ``step``."""
        return self.met_at is None and self.stop <= step <= self.stop + self.pressure_time

    def in_first_part(self, step: int) -> bool:
        """Return whether ``step`` is in the first part of the pressure."""
        return step < self.stop + SOFT_SHARE * self.pressure_time

    def observe(self, step: int, render: RenderOutput) -> None:
        super().observe(step, render)
        self.step = step

    def regularizer(self, gaussians: Gaussians) -> Tensor | None:
        step = self.step + 1
        if not self.pressing(step) or (step - 1) % self.pressure_interval:
            return None
        self.adjust_weight(step, gaussians.opacities.detach())
        logits = gaussians.opacity_logits + LOWEST_LOGIT
        if self.in_first_part(step):
            transparency = (1 - gaussians.opacities).clamp_min(MIN_TRANSPARENCY)
            return self.weight * (logits / transparency).mean().square()
        return HARD_FACTOR * self.weight * logits.mean().square()

    def adjust_weight(self, step: int, opacities: Tensor) -> None:
        """Adjust the weight so that the last opacity within the budget follows the aim."""
        place = min(self.max_gaussians, len(opacities)) - 1
        last = opacities.sort(descending=True).values[place].item()
        if self.aim is None:
            self.aim = FIRST_AIM * last
        elif (step - 1) % (2 * self.pressure_interval) == 0:
            progress = (step - self.stop) / ((1 - SOFT_SHARE) * self.pressure_time)
            goal = max(0.0, 1 - progress) * self.aim
            if last < (1 - BAND) * goal:
                self.weight *= WEAKER
            elif last > (1 + BAND) * goal:
                self.weight *= STRONGER

    def rules(self, refinement: Refinement) -> list[Rule]:
        """The rules of Improved-GS within the window, then those of the selection."""
        step, count = refinement.step, len(refinement.gaussians)
        if self.met_at is not None and step == self.met_at + round(SOFT_SHARE * self.pressure_time):
            return [partial(self.multiply_rate, factor=1.0)]
        if not self.pressing(step):
            return super().rules(refinement)
        if step == self.stop:
            return [partial(self.multiply_rate, factor=RATE_FACTOR)]
        ended = step == self.stop + self.pressure_time
        if ended or count < CLOSE * self.max_gaussians:
            return [self.meet_budget]
        pruning = step % self.pressure_interval == 0 and not self.in_first_part(step)
        return [partial(self.prune_below, opacity=self.selected_opacity)] if pruning else []

    def meet_budget(self, refinement: Refinement) -> None:
        """Keep ``max_gaussians`` Gaussians, drawn by opacity, and end the pressure."""
        opacities = refinement.gaussians.values.opacities
        candidates = torch.ones_like(opacities, dtype=torch.bool)
        kept = draw(candidates, opacities, self.max_gaussians, refinement.rng)
        if len(opacities) > CLOSE * self.max_gaussians:
            log.warning(
                "the opacity pressure was too short: it ended with %d Gaussians, and %d of them "
                "were removed at random; raise densify.pressure_length, or lower densify.interval "
                "(the pressure's is half of it)",
                len(opacities),
                int((~kept).sum()),
            )
        if not kept.all():
            self.remove(refinement, ~kept)
        self.met_at = refinement.step

    def multiply_rate(self, refinement: Refinement, factor: float) -> None:
        """Set the learning rate of opacities to ``factor`` times that of the settings."""
        refinement.gaussians.set_rate("opacity_logits", factor * refinement.gaussians.rates.opacity)

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {
            "selection": {name: getattr(self, name) for name in SELECTION}
        }

    def load_state_dict(self, state: dict[str, Any], context: DensifyContext) -> None:
        super().load_state_dict(state, context)
        for name in SELECTION:
            setattr(self, name, state["selection"][name])
