"""ResGS: a residual split, in stages of growing detail."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import torch
from annotated_types import Ge, Interval
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.adc import ADC
from gsbench.densify.base import Refinement, Rule
from gsbench.densify.scores import faded
from gsbench.errors import InputError
from gsbench.events import Cause
from gsbench.raster.base import RenderOutput
from gsbench.settings import OpenFraction

# rounds before the window in which gradients are gathered (200 iterations in the authors' code)
GATHER_ROUNDS = 2


@dataclass
class ResGS(ADC):
    """ADC with the residual split of Lyu et al. (ICCV 2025, arXiv 2412.07494).

    Each candidate stays, with its opacity multiplied by ``parent_opacity``, and gets one child. The
    child's mean is drawn from the parent's density, its scales are divided by ``split_shrink``, its
    opacity is the parent's former one, and its level is the parent's plus one. So the child adds
    the detail that the parent lacks.

    The window has phases, which end at the fractions ``phase_ends`` of it, and each phase has
    ``stages_a_phase`` equal stages. A Gaussian of level l grows in stage s > l at
    ``gradient_threshold`` times ``level_factor``^(l - s), so that Gaussians of low levels catch up.
    For ``warm_up`` of the window after the end of a phase, no gradients are gathered and nothing
    grows. From the fraction ``fade_start`` of the window until iteration ``fade_stop``, all
    opacities are multiplied by ``fade`` every ``fade_interval`` iterations. There is no opacity
    reset, and no pruning by size.
    """

    # number of residual splits from an initial Gaussian to this one
    STATISTICS: ClassVar = {"level": torch.int32}

    prunes_by_size = False

    gradient: Literal["signed", "absolute"] = "absolute"
    gradient_threshold: PositiveFloat = 6.7e-4
    parent_opacity: OpenFraction = 0.3
    # 2^(1/3): divides the threshold for each level that a Gaussian is behind the stage
    level_factor: Annotated[float, Ge(1)] = 2 ** (1 / 3)
    phase_ends: Sequence[OpenFraction] = field(default_factory=lambda: [0.16, 0.47])
    stages_a_phase: PositiveInt = 3
    warm_up: Annotated[float, Interval(ge=0, lt=1)] = 0.044
    fade: Annotated[float, Interval(gt=0, le=1)] = 0.8  # factor on all opacities
    # of the window: from the end of the first phase on, that iteration included
    fade_start: OpenFraction = 0.16
    fade_interval: PositiveInt = 500
    fade_stop: NonNegativeInt = 25_000

    def __post_init__(self) -> None:
        super().__post_init__()
        if list(self.phase_ends) != sorted(set(self.phase_ends)):
            raise InputError(f"densify.phase_ends must rise, got {list(self.phase_ends)}")

    def iteration_at(self, fraction: float) -> int:
        """The iteration of the round that is nearest to ``fraction`` of the window."""
        rounds = round(fraction * (self.stop - self.start) / self.interval)
        return self.start + rounds * self.interval

    def warming_up(self, step: int) -> bool:
        """Return whether ``step`` is in the pause after the end of a phase."""
        length = self.iteration_at(self.warm_up) - self.start
        return any(0 < step - self.iteration_at(end) < length for end in self.phase_ends)

    def stage(self, step: int) -> int:
        """The stage (1, 2, …) of the round at ``step``."""
        ends = [self.iteration_at(end) for end in self.phase_ends]
        phase = sum(step > end for end in ends)
        length = self.iteration_at(self.warm_up) - self.start
        begin = self.start if phase == 0 else ends[phase - 1] + length
        stage_length = max(((*ends, self.stop)[phase] - begin) // self.stages_a_phase, 1)
        # The authors' loop begins to count one iteration late in the first phase and one early in
        # the others.
        offset = 1 if phase == 0 else -1
        done = max(0, (step - begin - offset) // stage_length)
        return self.stages_a_phase * phase + 1 + min(done, self.stages_a_phase)

    def observe(self, step: int, render: RenderOutput) -> None:
        if step > self.start - GATHER_ROUNDS * self.interval and not self.warming_up(step):
            super().observe(step, render)

    def rules(self, refinement: Refinement) -> list[Rule]:
        step = refinement.step
        rules = [rule for rule in super().rules(refinement) if rule != self.reset_opacity]
        if self.warming_up(step):
            rules = []
        fading = self.iteration_at(self.fade_start) <= step < self.fade_stop
        if fading and step % self.fade_interval == 0:
            rules += [self.fade_all] if step < self.stop else [self.prune, self.fade_all]
        return rules

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        _, large = super().candidates(refinement)
        behind = (self.stage(refinement.step) - self.statistics["level"]).clamp_min(0)  # [N] levels
        # a higher mean instead of a lower threshold
        mean = self.mean_gradient() * self.level_factor ** behind.to(torch.float64)
        return self.reaches(mean, self.gradient_threshold * refinement.strictness), large

    def forecast(self, refinement: Refinement) -> int:
        logits, cull = refinement.gaussians.values.opacity_logits, refinement.cull
        over, _ = self.candidates(refinement)
        parents = torch.where(over, faded(logits, self.parent_opacity), logits)
        children = over & ~self.faint(logits, cull)
        return int((~self.faint(parents, cull)).sum()) + int(children.sum())

    def grow_by_gradient(self, refinement: Refinement) -> None:
        """Add a child for each candidate, then lower the candidate's opacity."""
        gaussians, before = refinement.gaussians, len(refinement.gaussians)
        over, _ = self.candidates(refinement)
        selected, blocked = self.choose(refinement, over, 1)
        levels = self.statistics["level"][selected] + 1
        refinement.event.split_gradient += self.split(
            refinement,
            selected,
            gaussians.values.log_scales[selected] - math.log(self.split_shrink),
            1,
            Cause.SPLIT_GRADIENT,
            keep_parent=True,
        )
        refinement.event.blocked_by_cap += blocked
        self.statistics["level"][before:] = levels
        parents = torch.zeros(len(gaussians), dtype=torch.bool, device=gaussians.device)
        parents[:before] = selected
        logits = gaussians.values.opacity_logits
        fainter = torch.where(parents, faded(logits, self.parent_opacity), logits)
        gaussians.overwrite("opacity_logits", fainter, where=parents)

    def reset_statistics(self, refinement: Refinement) -> None:
        """Set all statistics but the levels to zero."""
        levels = self.statistics["level"]
        super().reset_statistics(refinement)
        self.statistics["level"] = levels

    def fade_all(self, refinement: Refinement) -> None:
        """Multiply all opacities by ``fade``.

        Gaussians that are not needed become faint and are pruned.
        """
        logits = refinement.gaussians.values.opacity_logits
        refinement.gaussians.overwrite("opacity_logits", faded(logits, self.fade))
