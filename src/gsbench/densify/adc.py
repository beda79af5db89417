"""Adaptive density control (ADC) as in the 2023 code of 3DGS; later variants of it are options."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, NamedTuple

import torch
from annotated_types import Ge, Interval
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.base import Refinement, Rule
from gsbench.densify.budget import Budgeted, admit
from gsbench.densify.scores import draw, faded, lengths_of, revised_logits
from gsbench.events import Cause
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import RenderOutput
from gsbench.settings import OpenFraction

# limit for the children of one split; more would fill the memory in one round
MAX_CHILDREN = 64
# rounds after an opacity reset in which the governor does not raise ``cull``; our choice
LOCKED_ROUNDS = 5


class Grown(NamedTuple):
    """Results of the growth of a round for each of N Gaussians, before pruning."""

    number: Tensor  # [N] number of Gaussians that take its place, itself included
    log_scales: Tensor  # [N, 3] log scales of each of these
    opacity_logits: Tensor  # [N] opacity logit of each of these

    @classmethod
    def halved(
        cls, values: Gaussians, over: Tensor, log_scales: Tensor, opacity_factor: float
    ) -> "Grown":
        """Two with these scales, and fainter, for each Gaussian at the mask ``over`` [N]."""
        logits = values.opacity_logits
        return cls(
            torch.where(over, 2, 1),
            torch.where(over.unsqueeze(-1), log_scales, values.log_scales),
            torch.where(over, faded(logits, opacity_factor), logits),
        )


@dataclass
class ADC(Budgeted):
    """Clone small, split large, prune faint and huge Gaussians (Kerbl et al. 2023, section 5).

    A Gaussian grows if its gradient in NDC units, averaged over the iterations in which it was
    visible, reaches ``gradient_threshold``. Sizes are fractions of the scene extent.

    Examples:
        To try an idea, override one rule. This class never prunes:

        >>> @dataclass
        ... class NeverPrune(ADC):
        ...     def prune(self, refinement):
        ...         pass

        >>> NeverPrune(interval=50).gradient_threshold
        0.0002
    """

    STATISTICS: ClassVar = {
        "gradient_sum": torch.float32,  # NDC, since the last refinement
        "visible_count": torch.int32,  # iterations
        "max_radii": torch.int32,  # px
    }

    prunes_by_size: ClassVar[bool] = True

    gradient: Literal["signed", "absolute"] = "signed"  # absolute: AbsGS, arXiv 2404.10484
    # NDC, mean over the iterations in which a Gaussian was visible
    gradient_threshold: PositiveFloat = 2e-4
    threshold_inclusive: bool = True  # >= as 3DGS; False: > as gsplat
    # a larger Gaussian is split, else cloned ("percent_dense" of 3DGS)
    split_size: PositiveFloat = 0.01
    split_children: Annotated[int, Interval(ge=2, le=MAX_CHILDREN)] = 2
    split_shrink: Annotated[float, Ge(1)] = 1.6  # children's scales are divided by it (0.8 x 2)
    # children of clones and splits share their parent's opacity (arXiv 2404.06109)
    revised_opacity: bool = False
    prune_opacity: Annotated[float, Interval(ge=0, lt=1)] = 0.005
    prune_size: PositiveFloat = 0.1  # after the first opacity reset
    # px; 3DGS has 20, but zeroes the radii first, so it never acts
    prune_screen_radius: PositiveFloat | None = None
    opacity_reset_interval: PositiveInt = 3000
    opacity_reset_value: OpenFraction = 0.01

    @property
    def needs_absolute_gradient(self) -> bool:  # type: ignore[override]
        return self.gradient == "absolute"

    def observe(self, step: int, render: RenderOutput) -> None:
        if step < self.stop:
            self.gather(render)

    def gather(self, render: RenderOutput) -> None:
        """Gather the statistics of an iteration within the window."""
        visible, statistics = render.visible, self.statistics
        statistics["gradient_sum"] += torch.where(visible, self.screen_gradient(render), 0.0)
        statistics["visible_count"] += visible
        largest = statistics["max_radii"]
        torch.maximum(largest, render.radii, out=largest)

    def screen_gradient(self, render: RenderOutput) -> Tensor:
        """Length of the gradient by each projected mean, [N] NDC."""
        gradient = (
            render.screen_gradient_abs if self.gradient == "absolute" else render.screen_points.grad
        )
        if gradient is None:
            raise RuntimeError("observe needs the screen gradient: call it after backward")
        return lengths_of(gradient)

    def rules(self, refinement: Refinement) -> list[Rule]:
        """A round in the order of 3DGS, then the opacity reset."""
        step = refinement.step
        rules: list[Rule] = []
        if self.due(step):
            frozen = self.frozen(refinement)
            rules = [self.skip_round] if frozen else [*self.governing(), *self.round_at(step)]
        # As in 3DGS: with a white background, opacities are also reset once at the start of the
        # window.
        first = self.context.white_background and step == self.start
        if step < self.stop and (first or step % self.opacity_reset_interval == 0):
            rules.append(self.reset_opacity)
        return rules

    def round_at(self, step: int) -> list[Rule]:
        """The rules of a round that is not frozen, behind those of the governor."""
        return [self.grow_by_gradient, self.prune, self.reset_statistics]

    def mean(self, total: str, count: str = "visible_count") -> Tensor:
        """One statistic over another, [N]; 0 where both are."""
        return self.statistics[total] / self.statistics[count].clamp_min(1)

    def mean_gradient(self) -> Tensor:
        """Mean gradient [N] NDC over the iterations in which a Gaussian was visible."""
        return self.mean("gradient_sum")

    def candidates(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        """Return two masks [N]: the Gaussians to grow, and all large Gaussians.

        A Gaussian grows if its mean gradient reaches the threshold. A large one is then split, a
        small one cloned.
        """
        log_scales = refinement.gaussians.values.log_scales
        large = log_scales.amax(-1) > math.log(self.split_size * self.context.extent)
        limit = self.gradient_threshold * refinement.strictness
        return self.reaches(self.mean_gradient(), limit), large

    def reaches(self, mean: Tensor, limit: float) -> Tensor:
        """Mask [N] of the Gaussians whose ``mean`` gradient [N] reaches ``limit``."""
        return mean >= limit if self.threshold_inclusive else mean > limit

    def choose(self, refinement: Refinement, candidates: Tensor, gain: int) -> tuple[Tensor, int]:
        """Choose the ``candidates`` [N] with the largest mean gradients, as many as the cap admits.

        Each candidate adds ``gain`` Gaussians. Returns a mask [N] and the number of refused
        candidates.
        """
        return admit(candidates, self.mean_gradient(), gain, self.allowance(refinement))

    def grown(self, refinement: Refinement) -> Grown:
        """Return the result of growth for each Gaussian if the cap admitted all candidates."""
        values = refinement.gaussians.values
        over, large = self.candidates(refinement)
        logits = torch.where(over, revised_logits(values.opacity_logits), values.opacity_logits)
        return Grown(
            torch.where(over, torch.where(large, self.split_children, 2), 1),
            values.log_scales - math.log(self.split_shrink) * (over & large).unsqueeze(-1),
            logits if self.revised_opacity else values.opacity_logits,
        )

    def forecast(self, refinement: Refinement) -> int:
        grown = self.grown(refinement)
        faint = self.faint(grown.opacity_logits, refinement.cull)
        pruned = faint | self.huge(refinement.step, grown.log_scales)
        return int(grown.number[~pruned].sum())

    def grow_by_gradient(self, refinement: Refinement) -> None:
        """Clone small and split large Gaussians whose mean gradient reaches the threshold."""
        gaussians, event = refinement.gaussians, refinement.event
        over, large = self.candidates(refinement)
        selected, blocked = self.choose(refinement, over, self.split_children - 1)
        event.blocked_by_cap += blocked
        event.cloned += self.clone(
            refinement, selected & ~large, revised_opacity=self.revised_opacity
        )
        # Cloning appended Gaussians: extend the mask to them. A clone is not split in its first
        # round, as in 3DGS.
        not_split = selected.new_zeros(len(gaussians) - len(selected))
        to_split = torch.cat([selected & large, not_split])
        event.split_gradient += self.split(
            refinement,
            to_split,
            gaussians.values.log_scales[to_split] - math.log(self.split_shrink),
            self.split_children,
            Cause.SPLIT_GRADIENT,
            self.revised_opacity,
        )

    def faint(self, opacity_logits: Tensor, cull: float) -> Tensor:
        """Mask [N] of the Gaussians to prune by opacity."""
        return opacity_logits.sigmoid() < self.prune_opacity * cull

    def huge(self, step: int, log_scales: Tensor) -> Tensor:
        """Mask [N] of the Gaussians to prune by size; all False until the first opacity reset."""
        if not self.prunes_by_size or step <= self.opacity_reset_interval:
            return log_scales.new_zeros(len(log_scales), dtype=torch.bool)
        huge = log_scales.amax(-1) > math.log(self.prune_size * self.context.extent)
        if self.prune_screen_radius is not None:
            huge |= self.statistics["max_radii"] > self.prune_screen_radius
        return huge

    def may_cull(self, step: int) -> bool:
        """Return False in the first rounds after an opacity reset, when most opacities are low."""
        since_reset = step % self.opacity_reset_interval
        return (
            step <= self.opacity_reset_interval
            or not 0 < since_reset <= LOCKED_ROUNDS * self.interval
        )

    def to_prune(self, refinement: Refinement) -> tuple[Tensor, Tensor]:
        """Masks [N] of the faint and, after the first opacity reset, of the huge Gaussians."""
        values = refinement.gaussians.values
        faint = self.faint(values.opacity_logits, refinement.cull)
        return faint, self.huge(refinement.step, values.log_scales)

    def prune(self, refinement: Refinement) -> None:
        """Remove the Gaussians that `to_prune` selects."""
        self.remove(refinement, *self.to_prune(refinement))

    def prune_drawn(self, refinement: Refinement, known: Tensor, weights: Tensor) -> None:
        """Remove the Gaussians that `to_prune` selects and that a random draw selects, too.

        The draw takes Gaussians from the mask ``known`` [N], in proportion to ``weights`` [N], and
        half as many as `to_prune` selects.
        """
        faint, huge = self.to_prune(refinement)
        drawn = draw(known, weights, int((faint | huge).sum()) // 2, refinement.rng)
        self.remove(refinement, faint & drawn, huge & drawn)

    def reset_opacity(self, refinement: Refinement) -> None:
        """Lower all opacities. Those of needed Gaussians rise again; other Gaussians are pruned."""
        self.limit_opacity(refinement, self.opacity_reset_value)
        refinement.event.opacity_reset = True

    def limit_opacity(self, refinement: Refinement, ceiling: float) -> None:
        """Lower all opacities above ``ceiling`` to it.

        The moments of all opacities become zero, as in 3DGS.
        """
        limit = math.log(ceiling / (1 - ceiling))
        logits = refinement.gaussians.values.opacity_logits.clamp_max(limit)
        refinement.gaussians.overwrite("opacity_logits", logits)
