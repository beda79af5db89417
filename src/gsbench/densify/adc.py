"""Adaptive density control, as the 2023 implementation of 3DGS does it, with the family's departures as options."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import torch
from annotated_types import Ge, Interval
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.base import Densifier, DensifyContext, Refinement, Rule
from gsbench.densify.budget import CapKind, admit, allowance, check_room, limit_at
from gsbench.errors import InputError
from gsbench.events import Cause
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import OpenFraction

PAPER_CAP = 3_400_000  # the paper's, for the baseline and its own rule alike


@dataclass
class ADC(Densifier):
    """Clone what is small, split what is large, prune what is faint or huge (Kerbl et al. 2023, section 5).

    Sizes are fractions of the scene extent; ``gradient_threshold`` is in NDC units, averaged over the iterations in
    which a Gaussian was visible.
    """

    STATISTICS: ClassVar[dict[str, torch.dtype]] = {
        "gradient_sum": torch.float32,  # NDC, since the last refinement
        "visible_count": torch.int32,  # iterations
        "max_radii": torch.int32,  # px
    }

    start: NonNegativeInt = 500  # refine where start < step < stop and step % interval == 0
    stop: int = 15_000
    interval: PositiveInt = 100
    gradient: Literal["signed", "absolute"] = "signed"  # absolute: AbsGS, arXiv 2404.10484
    gradient_threshold: PositiveFloat = 2e-4
    threshold_inclusive: bool = True  # >= as 3DGS; False: > as gsplat
    split_size: PositiveFloat = 0.01  # largest scale above it: split, else clone ("percent_dense")
    split_children: Annotated[int, Ge(2)] = 2
    split_shrink: Annotated[float, Ge(1)] = 1.6  # children's scales are divided by it (0.8 x 2)
    revised_opacity: bool = False  # children of clones and splits share their parent's opacity (arXiv 2404.06109)
    prune_opacity: Annotated[float, Interval(ge=0, lt=1)] = 0.005
    prune_size: PositiveFloat = 0.1  # after the first opacity reset
    prune_screen_radius: PositiveFloat | None = None  # px; 3DGS means 20 but zeroes the radii first, so it never acts
    opacity_reset_interval: PositiveInt = 3000
    opacity_reset_value: OpenFraction = 0.01
    max_gaussians: PositiveInt | None = PAPER_CAP  # None: no limit, as 3DGS
    cap: CapKind = "soft"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stop <= self.start:
            raise InputError(f"densify.stop must be above densify.start ({self.start}), got {self.stop}")
        if self.cap == "curve" and self.max_gaussians is None:
            raise InputError("densify.max_gaussians must be set for densify.cap=curve")

    @property
    def needs_absolute_gradient(self) -> bool:  # type: ignore[override]
        return self.gradient == "absolute"

    def begin(self, gaussians: Gaussians, context: DensifyContext) -> None:
        if self.max_gaussians is not None:
            check_room(self.max_gaussians, len(gaussians))
        super().begin(gaussians, context)

    def observe(self, step: int, render: RenderOutput) -> None:
        if step >= self.stop:
            return
        gradient = render.screen_gradient_abs if self.gradient == "absolute" else render.screen_points.grad
        if gradient is None:
            raise RuntimeError(
                "observe needs the screen gradient: call it after backward, with absolute_gradient if used"
            )
        visible, statistics = render.visible, self.statistics
        statistics["gradient_sum"] += torch.where(visible, gradient.norm(dim=-1), 0.0)
        statistics["visible_count"] += visible
        statistics["max_radii"] = torch.maximum(statistics["max_radii"], render.radii)

    def due(self, step: int) -> bool:
        """Whether a round of growth and pruning is due."""
        return self.start < step < self.stop and step % self.interval == 0

    def rules(self, refinement: Refinement) -> list[Rule]:
        """A round in the order of the baseline, and its opacity reset."""
        step = refinement.step
        rules: list[Rule] = []
        if self.due(step):
            rules += [self.grow_by_gradient, self.prune, self.reset_statistics]
        periodic = step % self.opacity_reset_interval == 0
        if step < self.stop and (periodic or (self.context.white_background and step == self.start)):
            rules.append(self.reset_opacity)
        return rules

    def mean_gradient(self) -> Tensor:
        """[N] NDC, over the iterations in which a Gaussian was visible; 0 where it never was."""
        return self.statistics["gradient_sum"] / self.statistics["visible_count"].clamp_min(1)

    def grow_by_gradient(self, refinement: Refinement) -> None:
        """Clone the small and split the large of those whose mean gradient reaches the threshold."""
        gaussians, event = refinement.gaussians, refinement.event
        mean = self.mean_gradient()
        over = mean >= self.gradient_threshold if self.threshold_inclusive else mean > self.gradient_threshold
        large = gaussians.values.log_scales.amax(-1) > math.log(self.split_size * self.context.extent)  # [N]
        allowed = self.allowance(refinement)
        selected, blocked = admit(over, mean, max(1, self.split_children - 1), allowed)
        event.blocked_by_cap += blocked
        event.cloned += self.clone(refinement, selected & ~large, revised_opacity=self.revised_opacity)
        new = selected.new_zeros(len(gaussians) - len(selected))
        to_split = torch.cat([selected & large, new])  # clones never split
        event.split_gradient += self.split(
            refinement,
            to_split,
            gaussians.values.log_scales.detach()[to_split] - math.log(self.split_shrink),
            self.split_children,
            Cause.SPLIT_GRADIENT,
            self.revised_opacity,
        )

    def allowance(self, refinement: Refinement) -> int | None:
        """How many Gaussians may be added now; None for no limit."""
        initial = self.lineage.initial_count
        limit = limit_at(refinement.step, self.start, self.stop, initial, self.max_gaussians, self.cap)
        return allowance(len(refinement.gaussians), limit, self.cap)

    def prune(self, refinement: Refinement) -> None:
        """Remove the faint, and after the first opacity reset the huge."""
        values, event = refinement.gaussians.values, refinement.event
        faint = values.opacities < self.prune_opacity  # [N]
        huge = torch.zeros_like(faint)
        if refinement.step > self.opacity_reset_interval:
            huge = values.log_scales.amax(-1) > math.log(self.prune_size * self.context.extent)
            if self.prune_screen_radius is not None:
                huge |= self.statistics["max_radii"] > self.prune_screen_radius
        event.pruned_opacity += int(faint.sum())
        event.pruned_size += int((huge & ~faint).sum())
        self.edit(refinement, keep=~(faint | huge))

    def reset_opacity(self, refinement: Refinement) -> None:
        """Make everything faint, so that what is not needed stays so and is pruned."""
        limit = math.log(self.opacity_reset_value / (1 - self.opacity_reset_value))
        logits = refinement.gaussians.values.opacity_logits.detach().clamp_max(limit)
        refinement.gaussians.overwrite("opacity_logits", logits)
        refinement.event.opacity_reset = True
