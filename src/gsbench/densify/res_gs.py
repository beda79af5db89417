"""ResGS: a Gaussian that grows stays, fainter, and gets a smaller child; thresholds follow a level."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import torch
from annotated_types import Ge, Interval
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.adc import ADC
from gsbench.densify.base import Refinement, Rule
from gsbench.densify.operations import faded
from gsbench.errors import InputError
from gsbench.events import Cause
from gsbench.raster.base import RenderOutput
from gsbench.settings import OpenFraction, Switch

GATHER_ROUNDS = 2  # before the window's start gradients are gathered: 200 iterations in the authors' code


@dataclass
class ResGS(ADC):
    """ADC whose candidates keep their place with ``parent_opacity`` times their opacity and get one child each.

    Lyu et al. (ICCV 2025, arXiv 2412.07494): the child is drawn from the parent's density, is ``split_shrink`` smaller
    and as opaque as the parent was, so that it adds what is missing to what the parent showed. Its level is the
    parent's plus one. The window has stages; a Gaussian of level l in stage s > l grows at ``gradient_threshold`` times
    ``level_factor``^(l - s), so that those behind catch up. The stages are ``stages_a_phase`` equal parts of each
    phase of the window; phases end at ``phase_ends``, fractions of it, and for ``warm_up`` of the window after each end
    nothing is gathered and nothing grows. From ``fade_start`` of the window on all opacities are multiplied by ``fade``
    every ``fade_interval`` iterations, until ``fade_stop``. No opacity reset; pruned are the faint alone.
    """

    STATISTICS: ClassVar[dict[str, torch.dtype]] = {"level": torch.int32}  # how many residual splits made a Gaussian

    SWITCHES: ClassVar[Mapping[str, Switch]] = {
        "absolute_gradient": Switch({"gradient": "signed"}, "the absolute gradient, in which pixels do not cancel"),
        "fading": Switch({"fade": 1.0}, "opacities that fade"),
        "levels": Switch({"level_factor": 1.0}, "lower thresholds for those that earlier stages passed over"),
    }

    gradient: Literal["signed", "absolute"] = "absolute"
    gradient_threshold: PositiveFloat = 6.7e-4
    parent_opacity: OpenFraction = 0.3
    level_factor: Annotated[float, Ge(1)] = 2 ** (1 / 3)
    phase_ends: Sequence[OpenFraction] = field(default_factory=lambda: [0.16, 0.47])
    stages_a_phase: PositiveInt = 3
    warm_up: Annotated[float, Interval(ge=0, lt=1)] = 0.044
    fade: Annotated[float, Interval(gt=0, le=1)] = 0.8
    fade_start: OpenFraction = 0.16
    fade_interval: PositiveInt = 500
    fade_stop: NonNegativeInt = 25_000

    def __post_init__(self) -> None:
        super().__post_init__()
        if list(self.phase_ends) != sorted(set(self.phase_ends)):
            raise InputError(f"densify.phase_ends must rise, got {list(self.phase_ends)}")

    def iteration_at(self, fraction: float) -> int:
        """The iteration of the round nearest to a ``fraction`` of the window."""
        return self.start + round(fraction * (self.stop - self.start) / self.interval) * self.interval

    def warming_up(self, step: int) -> bool:
        """Return whether a phase ended so shortly before that nothing is gathered yet."""
        length = self.iteration_at(self.warm_up) - self.start
        return any(0 < step - self.iteration_at(end) < length for end in self.phase_ends)

    def stage(self, step: int) -> int:
        """The stage of the round at ``step``: 1, 2, …"""
        ends = [self.iteration_at(end) for end in self.phase_ends]
        phase = sum(step > end for end in ends)
        length = self.iteration_at(self.warm_up) - self.start
        begin = self.start if phase == 0 else ends[phase - 1] + length
        part = max(((*ends, self.stop)[phase] - begin) // self.stages_a_phase, 1)
        late = 1 if phase == 0 else -1  # when the authors' loop begins to count the iterations of a phase
        done = max(0, (step - begin - late) // part)
        return self.stages_a_phase * phase + 1 + min(done, self.stages_a_phase)

    def observe(self, step: int, render: RenderOutput) -> None:
        if step > self.start - GATHER_ROUNDS * self.interval and not self.warming_up(step):
            super().observe(step, render)

    def rules(self, refinement: Refinement) -> list[Rule]:
        step, rules = refinement.step, [rule for rule in super().rules(refinement) if rule != self.reset_opacity]
        if self.warming_up(step):
            rules = []
        fading = self.iteration_at(self.fade_start) <= step < self.fade_stop
        if fading and step % self.fade_interval == 0:
            rules += [self.fade_all] if step < self.stop else [self.prune, self.fade_all]
        return rules

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        _, large = super().candidates(refinement)
        behind = (self.statistics["level"] - self.stage(refinement.step)).clamp_max(0)  # [N]
        mean = self.mean_gradient() * self.level_factor ** -behind.to(torch.float64)  # held against the same threshold
        return self.reaches(mean, self.gradient_threshold), large

    def forecast(self, refinement: Refinement) -> int:
        values = refinement.gaussians.values
        over, _ = self.candidates(refinement)
        parents = torch.where(over, faded(values.opacity_logits, self.parent_opacity), values.opacity_logits)
        children = over & ~self.faint(values.opacity_logits)
        return int((~self.faint(parents)).sum()) + int(children.sum())

    def grow_by_gradient(self, refinement: Refinement) -> None:
        """Give each candidate a child, and make it fainter."""
        gaussians, before = refinement.gaussians, len(refinement.gaussians)
        over, _ = self.candidates(refinement)
        selected, blocked = self.choose(refinement, over, 1)
        levels = self.statistics["level"][selected] + 1
        refinement.event.split_gradient += self.split(
            refinement,
            selected,
            gaussians.values.log_scales.detach()[selected] - math.log(self.split_shrink),
            1,
            Cause.SPLIT_GRADIENT,
            keep_parent=True,
        )
        refinement.event.blocked_by_cap += blocked
        self.statistics["level"][before:] = levels
        parents = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.device)
        parents[:before] = selected
        logits = gaussians.values.opacity_logits.detach()
        fainter = torch.where(parents, faded(logits, self.parent_opacity), logits)
        gaussians.overwrite("opacity_logits", fainter, where=parents)

    def huge(self, step: int, log_scales: Tensor) -> Tensor:
        """A mask [N] without any Gaussian: these authors do not prune by size."""
        return torch.zeros_like(log_scales[:, 0], dtype=torch.bool)

    def reset_statistics(self, refinement: Refinement) -> None:
        """Gather anew; levels stay."""
        levels = self.statistics["level"]
        super().reset_statistics(refinement)
        self.statistics["level"] = levels

    def fade_all(self, refinement: Refinement) -> None:
        """Make everything a little fainter, so that what is not needed goes."""
        logits = refinement.gaussians.values.opacity_logits.detach()
        refinement.gaussians.overwrite("opacity_logits", faded(logits, self.fade))
