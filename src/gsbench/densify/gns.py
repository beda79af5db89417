"""GNS: growth beyond the budget, then a loss on all opacities until only as many Gaussians as budgeted remain."""

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

# From the authors' code, whose pressure acts every 50 iterations from iteration 15,000 to 23,000.
SOFT_SHARE = 1 / 8  # first part of the pressure: its term depends on opacity, and no Gaussian is pruned
FIRST_AIM = 0.8  # of the opacity of the last Gaussian within the budget, when the pressure begins
LOWEST_LOGIT = 20.0  # the pressure drives all opacity logits towards minus this
MIN_TRANSPARENCY = 0.05  # smallest divisor in the first part: an opacity of .95 weighs 20 times as much as one near 0
HARD_FACTOR = 3.0  # on the pressure after the first part
BAND, WEAKER, STRONGER = 0.1, 0.8, 1.2  # the weight is changed if the opacity is more than BAND from its aim
CLOSE = 1.05  # times the budget: below this, the excess is removed at once, by a random draw
RATE_FACTOR = 4.0  # on the learning rate of opacities, until `SOFT_SHARE` after the budget is met


@dataclass
class GNS(EdgeAware):
    """Improved-GS up to ``overgrowth`` times the budget, then natural selection (Deng et al., arXiv 2511.16980).

    The pressure lasts ``pressure_length`` of the window's length, from the end of the window. Every half interval, a
    term in the loss lowers all opacity logits l (opacity o): w (mean of (l + 20) / max(.05, 1 - o))^2 in the first
    eighth of that time, then 3 w (mean l + 20)^2. The photometric loss counteracts it for Gaussians that the pictures
    need. After the first eighth, Gaussians below ``selected_opacity`` are pruned.

    The weight w starts at ``pressure``. It is adjusted so that the opacity of the last Gaussian within the budget
    follows an aim, which falls from .8 of its initial value to 0 in seven eighths of the time. When the count is within
    5 % of the budget, or the time ends, exactly ``max_gaussians`` are kept, drawn by opacity. Meanwhile the learning
    rate of opacities is four times as high.

    ``max_gaussians`` is the final count; before, there are up to ``overgrowth`` times as many. If the training ends
    before the pressure does, the final count is higher, too.
    """

    cap: Literal["root"] = "root"
    max_gaussians: PositiveInt = 600_000
    overgrowth: Annotated[float, Ge(1)] = 3.0
    pressure: PositiveFloat = 2e-4
    pressure_length: Annotated[float, Interval(gt=0)] = 0.552
    selected_opacity: OpenFraction = 0.001

    def begin(self, gaussians: Gaussians, context: DensifyContext) -> None:
        super().begin(gaussians, context)
        self.step = 0  # last observed iteration
        self.weight = self.pressure
        self.aim: float | None = None  # initial value of the aimed opacity; None before the pressure
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
            return self.weight * (logits / (1 - gaussians.opacities).clamp_min(MIN_TRANSPARENCY)).mean().square()
        return HARD_FACTOR * self.weight * logits.mean().square()

    def adjust_weight(self, step: int, opacities: Tensor) -> None:
        """Adjust the weight of the pressure by the opacity of the last Gaussian within the budget."""
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
        """The rules of Improved-GS within the window, then those of the selection."""
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
        pruning = step % self.pressure_interval == 0 and not self.in_first_part(step)
        return [self.prune_transparent] if pruning else []

    def prune_transparent(self, refinement: Refinement) -> None:
        """Remove the Gaussians that the pressure has made transparent."""
        self.prune_below(refinement, self.selected_opacity)

    def meet_budget(self, refinement: Refinement) -> None:
        """Keep ``max_gaussians`` Gaussians, drawn by opacity, and end the pressure."""
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
        """Raise the learning rate of opacities for the pressure and for a while after it."""
        refinement.gaussians.set_rate("opacity_logits", RATE_FACTOR * refinement.gaussians.rates.opacity)

    def restore_rate(self, refinement: Refinement) -> None:
        """Restore the learning rate of opacities."""
        refinement.gaussians.set_rate("opacity_logits", refinement.gaussians.rates.opacity)

    def state_dict(self) -> dict[str, Any]:
        selection = {"step": self.step, "weight": self.weight, "aim": self.aim, "met_at": self.met_at}
        return super().state_dict() | {"selection": selection}

    def load_state_dict(self, state: dict[str, Any], context: DensifyContext) -> None:
        super().load_state_dict(state, context)
        saved = state["selection"]
        self.step, self.weight, self.aim, self.met_at = (saved[key] for key in ("step", "weight", "aim", "met_at"))
