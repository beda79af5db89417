"""A complete densifier with a budget; docs/densifier.md says how to run it."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from annotated_types import Ge, Gt, Interval

from gsbench.densify import Budgeted, Cause
from gsbench.densify.budget import admit


@dataclass
class SplitLargest(Budgeted):
    """Splits large Gaussians among those seen since the last round; removes faint ones."""

    size: Annotated[float, Gt(0)] = 0.02  # of the scene's extent; what is larger is split
    shrink: Annotated[float, Ge(1)] = 1.6  # children's scales are divided by it
    prune_opacity: Annotated[float, Interval(ge=0, lt=1)] = 0.005

    STATISTICS: ClassVar = {"seen": torch.bool}  # since the last round

    def observe(self, step, render):
        self.statistics["seen"] |= render.visible

    def rules(self, refinement):
        steps = [*self.governing(), self.prune_faint, self.split_large, self.reset_statistics]
        return steps if self.due(refinement.step) else []

    def faint(self, refinement):
        return refinement.gaussians.values.opacities < self.prune_opacity * refinement.cull

    def large(self, refinement):
        limit = self.size * self.context.extent * refinement.strictness
        return self.statistics["seen"] & (refinement.gaussians.values.scales.amax(-1) > limit)

    def prune_faint(self, refinement):
        self.remove(refinement, self.faint(refinement))

    def split_large(self, refinement):
        values = refinement.gaussians.values.detach()
        large, blocked = admit(
            self.large(refinement), values.scales.amax(-1), 1, self.allowance(refinement)
        )
        refinement.event.blocked_by_cap += blocked
        children = values.log_scales[large] - math.log(self.shrink)
        added = self.split(refinement, large, children, 2, Cause.SPLIT_VOLUME)
        refinement.event.split_volume += added  # two children for one parent: one more than before

    def forecast(self, refinement):  # the count after a round, for cap=governor
        kept = ~self.faint(refinement)
        return int(kept.sum() + (kept & self.large(refinement)).sum())
