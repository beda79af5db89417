"""GNS: grow beyond the budget, then press on all opacities until only the budget's Gaussians hold out."""

import logging
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Interval
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.base import DensifyContext, Refinement, Rule
from gsbench.densify.edge_aware import EdgeAware
from gsbench.densify.scores import draw
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import OpenFraction

log = logging.getLogger(__name__)

# Of the authors' code, in the iterations of its schedule: pressure from 15,000 to 23,000, every 50 of them.
SOFT_SHARE = 1 / 8  # of the time under pressure: the opaque are spared, and nobody is pruned
FIRST_AIM = 0.8  # of the opacity of the least of those that may stay, when the pressure begins
LOWEST_LOGIT = 20.0  # below zero: where the pressure drives all opacities
SPARED = 0.05  # least divisor: an opacity of .95 and more is pressed twenty times as hard as one near 0
HARD_FACTOR = 3.0  # of the pressure that spares nobody
BAND, WEAKER, STRONGER = 0.1, 0.8, 1.2  # the weight follows where the opacity is so far from its aim
CLOSE = 1.05  # times the budget: the rest is drawn
RATE_FACTOR = 4.0  # on the opacities' learning rate, until `SOFT_SHARE` after the budget is met


@dataclass
class GNS(EdgeAware):
    """Improved-GS up to ``overgrowth`` times the budget, then natural selection; Deng et al. (arXiv 2511.16980).

    From the end of the window, for ``pressure_length`` of the window's length, every half interval a term in the loss
    presses on all opacity logits l: w (mean of (l + 20) / max(.05, 1 - o))^2 for the first eighth of that time, then
    3 w (mean l + 20)^2. Rendering pushes back for those that it needs. The weight w, at first ``pressure``, follows an
    aim for the opacity of the last Gaussian within the budget, which falls from .8 of what it was to 0 in seven eighths
    of that time. Those below ``selected_opacity`` go. Within 5 % of the budget, or at the end of the time, exactly
    ``max_gaussians`` stay, drawn by opacity. The opacities' learning rate is four times as high meanwhile.

    ``max_gaussians`` is the count at the end; in between there are up to ``overgrowth`` times as many. Where the
    training ends before the pressure does, there are more at the end, too.
    """

    cap: Literal["root"] = "root"
    max_gaussians: PositiveInt = 600_000
    overgrowth: Annotated[float, Ge(1)] = 3.0
    pressure: PositiveFloat = 2e-4
    pressure_length: Annotated[float, Interval(gt=0)] = 0.552
    selected_opacity: OpenFraction = 0.001

    def begin(self, gaussians: Gaussians, context: DensifyContext) -> None:
        super().begin(gaussians, context)
        self.step = 0  # the last one observed
        self.weight = self.pressure
        self.aim: float | None = None  # where the aimed opacity started; None before the pressure
        self.met_at: int | None = None  # the iteration at which the budget was met

    @property
    def most_gaussians(self) -> int:
        return int(self.overgrowth * self.max_gaussians)

    @property
    def pressure_interval(self) -> int:
        return max(1, self.interval // 2)

    @property
    def pressure_time(self) -> int:
        """Iterations from the end of the window to the end of the pressure."""
        rounds = max(1, round(self.pressure_length * (self.stop - self.start) / self.interval))
        return rounds * self.interval

    def pressing(self, step: int) -> bool:
        """Return whether selection is under way at ``step``."""
        return self.met_at is None and self.stop <= step <= self.stop + self.pressure_time

    def soft(self, step: int) -> bool:
        """Return whether the pressure of ``step`` spares the opaque."""
        return step < self.stop + SOFT_SHARE * self.pressure_time

    def observe(self, step: int, render: RenderOutput) -> None:
        super().observe(step, render)
        self.step = step

    def regularizer(self, gaussians: Gaussians) -> Tensor | None:
        step = self.step + 1
        if not self.pressing(step) or (step - 1) % self.pressure_interval:
            return None
        self.follow(step, gaussians.opacities.detach())
        logits = gaussians.opacity_logits + LOWEST_LOGIT
        if self.soft(step):
            return self.weight * (logits / (1 - gaussians.opacities).clamp_min(SPARED)).mean().square()
        return HARD_FACTOR * self.weight * logits.mean().square()

    def follow(self, step: int, opacities: Tensor) -> None:
        """Strengthen or weaken the pressure by the opacity of the last Gaussian within the budget."""
        last = opacities.sort(descending=True).values[min(self.max_gaussians, len(opacities)) - 1].item()
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
        """The rules of Improved-GS in the window, then the selection."""
        step, count = refinement.step, len(refinement.gaussians)
        if self.met_at is not None and step == self.met_at + round(SOFT_SHARE * self.pressure_time):
            return [self.restore_rate]
        if not self.pressing(step):
            return super().rules(refinement)
        if step == self.stop:
            return [self.raise_rate]
        ended = step == self.stop + self.pressure_time
        if ended or count < CLOSE * self.max_gaussians:
            return [self.meet_budget]
        selecting = step % self.pressure_interval == 0 and not self.soft(step)
        return [self.select] if selecting else []

    def select(self, refinement: Refinement) -> None:
        """Remove those that the pressure has made transparent."""
        self.prune_below(refinement, self.selected_opacity)

    def meet_budget(self, refinement: Refinement) -> None:
        """Keep as many as the budget has, drawn by opacity, and end the selection."""
        opacities = refinement.gaussians.values.opacities.detach()
        kept = draw(torch.ones_like(opacities, dtype=torch.bool), opacities, self.max_gaussians, refinement.rng)
        if len(opacities) > CLOSE * self.max_gaussians:
            log.warning(
                "the opacity pressure was too short: it ended with %d Gaussians, and %d of them were removed at "
                "random; raise densify.pressure_length, or lower densify.interval (the pressure's is half of it)",
                len(opacities),
                int((~kept).sum()),
            )
        if not kept.all():
            self.remove(refinement, ~kept)
        self.met_at = refinement.step

    def raise_rate(self, refinement: Refinement) -> None:
        """Let opacities move faster, under pressure and for a while after it."""
        refinement.gaussians.set_rate("opacity_logits", RATE_FACTOR * refinement.gaussians.rates.opacity)

    def restore_rate(self, refinement: Refinement) -> None:
        """Set the usual learning rate of opacities again."""
        refinement.gaussians.set_rate("opacity_logits", refinement.gaussians.rates.opacity)

    def state_dict(self) -> dict[str, Any]:
        own = {"step": self.step, "weight": self.weight, "aim": self.aim, "met_at": self.met_at}
        return super().state_dict() | {"selection": own}

    def load_state_dict(self, state: dict[str, Any], context: DensifyContext) -> None:
        super().load_state_dict(state, context)
        own = state["selection"]
        self.step, self.weight, self.aim, self.met_at = (own[key] for key in ("step", "weight", "aim", "met_at"))
