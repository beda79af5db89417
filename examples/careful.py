"""A densifier with a setting, and with state over rounds; docs/densifier.md says how to run it."""

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge

from gsbench.densify import ADC


@dataclass
class Careful(ADC):
    """ADC whose threshold rises with the growth of the last round."""

    care: Annotated[float, Ge(0)] = 1.0  # a setting: densify.care

    def begin(self, gaussians, context):
        super().begin(gaussians, context)
        self.growth = 0.0  # state: the share by which the last round grew

    def candidates(self, refinement):
        over, large = super().candidates(refinement)
        limit = self.gradient_threshold * (1 + self.care * self.growth)
        return over & self.reaches(self.mean_gradient(), limit), large

    def grow_by_gradient(self, refinement):
        before = len(refinement.gaussians)
        super().grow_by_gradient(refinement)
        self.growth = len(refinement.gaussians) / before - 1

    def state_dict(self):
        return super().state_dict() | {"growth": self.growth}

    def load_state_dict(self, state, context):
        super().load_state_dict(state, context)
        self.growth = state["growth"]
