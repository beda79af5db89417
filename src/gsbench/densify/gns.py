"""GNS: Improved-GS, then natural selection by a pressure on opacities."""

import logging
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Interval
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.base import DensifyContext, Refinement, Rule
from gsbench.densify.improved_gs import EdgeAware
from gsbench.densify.scores import draw
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import OpenFraction

log = logging.getLogger(__name__)

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
        opacities = refinement.gaussians.values.opacities.detach()
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
