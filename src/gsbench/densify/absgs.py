"""AbsGS: clones by the signed gradient, splits by the absolute gradient, and keeps opacities below a ceiling."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.adc import ADC, OPACITY_RESET
from gsbench.densify.base import NEVER, Refinement, Rule
from gsbench.densify.budget import admit
from gsbench.raster.base import RenderOutput
from gsbench.settings import OpenFraction, Switch


@dataclass
class AbsGS(ADC):
    """ADC with two gradients and a ceiling on opacities, as in the code of Ye et al. (arXiv 2404.10484).

    Small Gaussians are cloned if their signed mean gradient reaches ``gradient_threshold``. Large ones are split if
    their absolute mean gradient, in which the pixels of a Gaussian do not cancel, reaches ``split_threshold``. Every
    ``ceiling_interval`` iterations, all opacities above ``opacity_ceiling`` are lowered to it, so that no Gaussian
    hides all that is behind it.
    """

    STATISTICS: ClassVar[dict[str, torch.dtype]] = {"absolute_sum": torch.float32}  # NDC, since the last refinement
    needs_absolute_gradient = True

    SWITCHES: ClassVar[Mapping[str, Switch]] = {
        "opacity_ceiling": Switch({"ceiling_interval": NEVER}, "the ceiling on opacities"),
        "small_split_size": Switch({"split_size": ADC.split_size}, "the smaller size above which a Gaussian is split"),
        "opacity_reset": OPACITY_RESET,
    }

    split_size: PositiveFloat = 0.001
    split_threshold: PositiveFloat = 4e-4
    opacity_ceiling: OpenFraction = 0.8
    ceiling_interval: PositiveInt = 500

    def observe(self, step: int, render: RenderOutput) -> None:
        super().observe(step, render)
        if step < self.stop:
            assert render.screen_gradient_abs is not None  # because of needs_absolute_gradient
            self.statistics["absolute_sum"] += torch.where(render.visible, render.screen_gradient_abs.norm(dim=-1), 0.0)

    def mean_absolute_gradient(self) -> Tensor:
        """Absolute mean gradient [N] NDC over the iterations in which a Gaussian was visible; 0 if it never was."""
        return self.statistics["absolute_sum"] / self.statistics["visible_count"].clamp_min(1)

    def rules(self, refinement: Refinement) -> list[Rule]:
        """The rules of ADC, with the ceiling inserted before the opacity reset."""
        rules, step = super().rules(refinement), refinement.step
        if step < self.stop and step % self.ceiling_interval == 0:
            rules.insert(len(rules) - (self.reset_opacity in rules), self.lower_opacity)
        return rules

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        over, large = super().candidates(refinement)
        return torch.where(large, self.reaches(self.mean_absolute_gradient(), self.split_threshold), over), large

    def choose(self, refinement: Refinement, candidates: Tensor, gain: int) -> tuple[Tensor, int]:
        """Choose the candidates farthest above the threshold that applies to them."""
        _, large = self.candidates(refinement)
        signed = self.mean_gradient() / self.gradient_threshold
        excess = torch.where(large, self.mean_absolute_gradient() / self.split_threshold, signed)  # [N]
        return admit(candidates, excess, gain, self.allowance(refinement))

    def lower_opacity(self, refinement: Refinement) -> None:
        """Lower all opacities above the ceiling to it."""
        self.limit_opacity(refinement, self.opacity_ceiling)
