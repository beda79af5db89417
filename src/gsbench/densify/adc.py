"""Adaptive density control, as the 2023 implementation of 3DGS does it, with the family's departures as options."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Interval
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.base import Densifier, DensifyContext
from gsbench.densify.budget import CapKind, admit, allowance, check_room, limit_at
from gsbench.densify.events import Cause, RefineEvent
from gsbench.densify.operations import revised_logits, split
from gsbench.errors import InputError
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import OpenFraction

PAPER_CAP = 3_400_000  # the paper's, for the baseline and its own rule alike


@dataclass
class ADC(Densifier):
    """Clone what is small, split what is large, prune what is faint or huge (Kerbl et al. 2023, section 5).

    Sizes are fractions of the scene extent; ``gradient_threshold`` is in NDC units, averaged over the iterations in
    which a Gaussian was visible.
    """

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

    initial_count: int = field(init=False, repr=False, compare=False, default=0)
    gradient_sum: Tensor = field(init=False, repr=False, compare=False)  # [N] NDC, since the last refinement
    visible_count: Tensor = field(init=False, repr=False, compare=False)  # [N] iterations
    max_radii: Tensor = field(init=False, repr=False, compare=False)  # [N] px

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
        self.initial_count = len(gaussians)
        self._forget_statistics(len(gaussians), gaussians.means.device)

    def observe(self, step: int, render: RenderOutput) -> None:
        if step >= self.stop:
            return
        gradient = render.screen_gradient_abs if self.gradient == "absolute" else render.screen_points.grad
        if gradient is None:
            raise RuntimeError(
                "observe needs the screen gradient: call it after backward, with absolute_gradient if used"
            )
        visible = render.visible  # [N]
        self.gradient_sum += torch.where(visible, gradient.norm(dim=-1), 0.0)
        self.visible_count += visible
        self.max_radii = torch.maximum(self.max_radii, render.radii)

    @torch.no_grad()
    def refine(self, step: int, gaussians: TrainableGaussians, rng: torch.Generator) -> RefineEvent | None:
        if step >= self.stop:
            return None
        due = step > self.start and step % self.interval == 0
        reset = step % self.opacity_reset_interval == 0 or (self.context.white_background and step == self.start)
        if not (due or reset):
            return None
        event = RefineEvent(step=step, before=len(gaussians))
        if due:
            self._grow_and_prune(step, gaussians, rng, event)
        if reset:
            self._reset_opacity(gaussians, event)
        event.after = len(gaussians)
        return event

    def _grow_and_prune(
        self, step: int, gaussians: TrainableGaussians, rng: torch.Generator, event: RefineEvent
    ) -> None:
        """One round in the order of the baseline; a subclass adds its rule to it."""
        self._grow_by_gradient(step, gaussians, rng, event)
        self._prune(step, gaussians, event)
        self._forget_statistics(len(gaussians), gaussians.device)

    def _grow_by_gradient(
        self, step: int, gaussians: TrainableGaussians, rng: torch.Generator, event: RefineEvent
    ) -> None:
        mean = self.gradient_sum / self.visible_count.clamp_min(1)  # [N]; never seen: 0
        over = mean >= self.gradient_threshold if self.threshold_inclusive else mean > self.gradient_threshold
        large = gaussians.values.log_scales.amax(-1) > math.log(self.split_size * self.context.extent)  # [N]
        gain = self.split_children - 1
        allowed = self._allowance(step, len(gaussians))
        selected, blocked = admit(over, mean, max(1, gain), allowed)
        event.blocked_by_cap += blocked
        self._clone(step, gaussians, selected & ~large, event)
        to_split = torch.cat(
            [selected & large, selected.new_zeros(len(gaussians) - len(selected))]
        )  # clones never split
        event.split_gradient += self._split(
            step,
            gaussians,
            to_split,
            gaussians.values.log_scales.detach()[to_split] - math.log(self.split_shrink),
            self.split_children,
            rng,
            Cause.SPLIT_GRADIENT,
            self.revised_opacity,
        )

    def _allowance(self, step: int, num_gaussians: int) -> int | None:
        limit = limit_at(step, self.start, self.stop, self.initial_count, self.max_gaussians, self.cap)
        return allowance(num_gaussians, limit, self.cap)

    def _clone(self, step: int, gaussians: TrainableGaussians, selected: Tensor, event: RefineEvent) -> None:
        parents = selected.nonzero().squeeze(-1)  # [C]
        if self.revised_opacity and len(parents):
            logits = gaussians.values.opacity_logits.detach().clone()
            logits[parents] = revised_logits(logits[parents])
            gaussians.overwrite("opacity_logits", logits, where=selected)
        copies = gaussians.values.detach().select(parents)
        self._edit(gaussians, step, append=copies, parents=parents, cause=Cause.CLONE)
        event.cloned += len(parents)

    def _split(
        self,
        step: int,
        gaussians: TrainableGaussians,
        selected: Tensor,
        child_log_scales: Tensor,
        children: int,
        rng: torch.Generator,
        cause: Cause,
        revised_opacity: bool = False,
        keep_parent: bool = False,
        sampled: bool = True,
    ) -> int:
        """Replace the Gaussians at the mask ``selected`` [N] by children; returns how many more there are than
        before."""
        parents = selected.nonzero().squeeze(-1)  # [S]
        new = split(gaussians.values.detach().select(parents), children, child_log_scales, rng, sampled)
        if revised_opacity:
            new.opacity_logits = revised_logits(new.opacity_logits)
        keep = None if keep_parent else ~selected
        self._edit(gaussians, step, keep=keep, append=new, parents=parents.repeat(children), cause=cause)
        return len(new) - (0 if keep_parent else len(parents))

    def _prune(self, step: int, gaussians: TrainableGaussians, event: RefineEvent) -> None:
        values = gaussians.values
        faint = values.opacities < self.prune_opacity  # [N]
        huge = torch.zeros_like(faint)
        if step > self.opacity_reset_interval:
            huge = values.log_scales.amax(-1) > math.log(self.prune_size * self.context.extent)
            if self.prune_screen_radius is not None:
                huge |= self.max_radii > self.prune_screen_radius
        event.pruned_opacity += int(faint.sum())
        event.pruned_size += int((huge & ~faint).sum())
        self._edit(gaussians, step, keep=~(faint | huge))

    def _reset_opacity(self, gaussians: TrainableGaussians, event: RefineEvent) -> None:
        limit = math.log(self.opacity_reset_value / (1 - self.opacity_reset_value))
        gaussians.overwrite("opacity_logits", gaussians.values.opacity_logits.detach().clamp_max(limit))
        event.opacity_reset = True

    def _forget_statistics(self, num_gaussians: int, device: torch.device) -> None:
        self.gradient_sum = torch.zeros(num_gaussians, device=device)  # [N] NDC
        self.visible_count = torch.zeros(num_gaussians, dtype=torch.int32, device=device)  # [N] iterations
        self.max_radii = torch.zeros(num_gaussians, dtype=torch.int32, device=device)  # [N] px

    def _carry_statistics(self, keep: Tensor | None, added: int) -> None:
        """Rules that come later in the round need them; the new have none yet."""
        self.gradient_sum = _carried(self.gradient_sum, keep, added)
        self.visible_count = _carried(self.visible_count, keep, added)
        self.max_radii = _carried(self.max_radii, keep, added)

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {
            "initial_count": self.initial_count,
            "gradient_sum": self.gradient_sum.clone(),
            "visible_count": self.visible_count.clone(),
            "max_radii": self.max_radii.clone(),
        }

    def load_state_dict(self, state: dict[str, Any], context: DensifyContext) -> None:
        super().load_state_dict(state, context)
        self.initial_count = state["initial_count"]
        self.gradient_sum = state["gradient_sum"].clone()
        self.visible_count = state["visible_count"].clone()
        self.max_radii = state["max_radii"].clone()


def _carried(statistic: Tensor, keep: Tensor | None, added: int) -> Tensor:
    """A statistic [N] after an edit: that of the kept, then zeros."""
    kept = statistic if keep is None else statistic[keep]
    return torch.cat([kept, kept.new_zeros(added)])
