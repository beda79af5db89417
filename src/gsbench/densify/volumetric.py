"""The volume rule of arXiv 2508.05187: ADC that also splits Gaussians whose volume is too large.

Questions that the paper leaves open are options. Their defaults follow the paper's equations or,
where these say nothing, the split of ADC. Volumes and condition numbers are computed in log space.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Ge, Interval
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from gsbench.densify.adc import ADC, MAX_CHILDREN, Grown
from gsbench.densify.base import Refinement, Rule
from gsbench.densify.budget import admit
from gsbench.densify.scores import quantile
from gsbench.errors import InputError
from gsbench.events import Cause
from gsbench.gaussians.paper_values import VOLUME_THRESHOLD
from gsbench.settings import OpenFraction

LOG_SPHERE = math.log(4 * math.pi / 3)


def log_volume(log_scales: Tensor) -> Tensor:
    """log V = log(4 pi / 3) + sum of log s_i (eq. 5), [N] from [N, 3]; V in cubed world units."""
    return LOG_SPHERE + log_scales.sum(-1)


def log_condition(log_scales: Tensor) -> Tensor:
    """log kappa = 2 (log s_max - log s_min) >= 0 (eq. 6), [N] from [N, 3].

    kappa is the ratio of the largest to the smallest eigenvalue s^2.
    """
    return 2 * (log_scales.amax(-1) - log_scales.amin(-1))


ThresholdMode = Literal["absolute", "extent_relative", "quantile", "auto"]
TUKEY_FENCE = 1.5  # interquartile ranges above the third quartile (Tukey 1977)
# of the extent: 0.1 px at a distance of one extent with a focal length of 1000 px
VANISHING_SIZE = 1e-4


@dataclass
class Volumetric(ADC):
    """ADC that also splits every Gaussian with V > V_th (eq. 5 to 7, Fig. 4).

    By default, this split comes before the pruning of ADC. ``threshold_mode`` determines V_th:

    - ``absolute``: ``volume_threshold``, in cubed units of the COLMAP model (the paper);
    - ``extent_relative``: ``volume_threshold`` times the cubed scene extent;
    - ``quantile``: the ``volume_quantile`` of all volumes;
    - ``auto``: the upper Tukey fence of log V, which is the third quartile plus 1.5 interquartile
      ranges. It adapts to the scene in any gauge, and selects few Gaussians if no volume stands
      out.

    ``volume_start``, ``volume_stop`` and ``volume_interval`` default to those of ADC.

    ``cap=governor`` multiplies the gradient threshold by one factor, and V_th by that factor to the
    power ``governor_dimension``. With 3 the factor acts on a size, whose cube is V_th. With 1 it
    acts on V_th itself.
    """

    # V_th, in the units of the COLMAP model cubed
    volume_threshold: PositiveFloat = VOLUME_THRESHOLD
    threshold_mode: ThresholdMode = "absolute"
    volume_quantile: OpenFraction = 0.9978  # 99.78 % of the volumes of Mip-NeRF 360 lie below 0.03
    # kappa divides eigenvalues (eq. 7), scales, or nothing: then children's scales are those of ADC
    condition_of: Literal["eigenvalues", "scales", "nothing"] = "eigenvalues"
    # limits kappa, so that children of needles do not vanish
    max_condition: Annotated[float, Ge(1)] | None = None
    # False: do not split a Gaussian whose children would be above the threshold again
    split_isotropic: bool = True
    volume_children: Annotated[int, Interval(ge=2, le=MAX_CHILDREN)] = 2
    keep_parent: bool = False
    # sampled from the parent's density | parent_mean
    placement: Literal["sampled", "parent_mean"] = "sampled"
    # after_adc | before_adc | after_prune; under a cap, the first rule takes places first
    volume_order: Literal["after_adc", "before_adc", "after_prune"] = "after_adc"
    volume_start: NonNegativeInt | None = None  # null: as in ADC
    volume_stop: NonNegativeInt | None = None
    volume_interval: PositiveInt | None = None
    governor_dimension: Literal[1, 3] = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.volume_interval is not None and self.volume_interval % self.interval:
            raise InputError(
                "densify.volume_interval must be a multiple of densify.interval "
                f"({self.interval}), "
                f"got {self.volume_interval}"
            )

    def round_at(self, step: int) -> list[Rule]:
        """The rules of ADC, with the split by volume inserted according to ``volume_order``."""
        rules = super().round_at(step)
        if self.volume_due(step):
            next_rule = {
                "before_adc": self.grow_by_gradient,
                "after_adc": self.prune,
                "after_prune": self.reset_statistics,
            }[self.volume_order]
            rules.insert(rules.index(next_rule), self.split_by_volume)
        return rules

    def volume_due(self, step: int) -> bool:
        """Return whether a round at ``step`` splits by volume."""
        start = self.start if self.volume_start is None else self.volume_start
        stop = self.stop if self.volume_stop is None else self.volume_stop
        return start < step < stop and step % (self.volume_interval or self.interval) == 0

    def child_log_scales(self, log_scales: Tensor) -> Tensor:
        """Log scales of children (eq. 7), [N, 3], given those of their parents.

        ``condition_of`` says what kappa divides. ``eigenvalues``: lambda' = lambda / kappa, so log
        s' = log s - log(kappa) / 2. ``scales``: s' = s / kappa. ``nothing``: s' = s /
        ``split_shrink``, as in ADC, instead of eq. 7.
        """
        if self.condition_of == "nothing":
            return log_scales - math.log(self.split_shrink)
        condition = log_condition(log_scales)  # [N]
        if self.max_condition is not None:
            condition = condition.clamp_max(math.log(self.max_condition))
        factor = 0.5 if self.condition_of == "eigenvalues" else 1.0
        return log_scales - (factor * condition).unsqueeze(-1)

    @property
    def volume_gain(self) -> int:
        """The number of Gaussians that one split by volume adds."""
        return self.volume_children - (0 if self.keep_parent else 1)

    def selected_by_volume(self, log_scales: Tensor, strictness: float) -> Tensor:
        """Mask [N] of the Gaussians to split by volume."""
        volumes = log_volume(log_scales)
        threshold = self.log_threshold(volumes, strictness)
        if self.split_isotropic:
            return volumes > threshold
        children = log_volume(self.child_log_scales(log_scales))
        return (volumes > threshold) & (children <= threshold)

    def grown(self, refinement: Refinement) -> Grown:
        """Return the result of growth if the cap admitted all candidates of both rules."""
        grown = super().grown(refinement)
        if not self.volume_due(refinement.step):
            return grown
        number, log_scales = grown.number, grown.log_scales
        # children of the volume rule have no gradients, so they do not grow
        if self.volume_order == "before_adc":
            before = refinement.gaussians.values.log_scales
            large = self.selected_by_volume(before, refinement.strictness)
            number = torch.where(large, 1, number)
            log_scales = torch.where(large.unsqueeze(-1), before, log_scales)
        else:
            large = self.selected_by_volume(log_scales, refinement.strictness)
        number = torch.where(large, (1 + self.volume_gain) * number, number)
        # After pruning, the forecast of pruning must still see the parents' scales.
        if self.volume_order != "after_prune":
            children = self.child_log_scales(log_scales)
            log_scales = torch.where(large.unsqueeze(-1), children, log_scales)
        return grown._replace(number=number, log_scales=log_scales)

    def split_by_volume(self, refinement: Refinement) -> None:
        """Split every Gaussian with V > V_th (eq. 5 to 7)."""
        event, strictness = refinement.event, refinement.strictness
        log_scales = refinement.gaussians.values.log_scales
        volumes = log_volume(log_scales)  # [N]
        threshold = self.log_threshold(volumes, strictness)
        children = self.child_log_scales(log_scales)  # [N, 3]
        candidates = self.selected_by_volume(log_scales, strictness)
        selected, blocked = admit(candidates, volumes, self.volume_gain, self.allowance(refinement))
        split_again = log_volume(children) > threshold  # [N] the next round would split them, too
        vanishing = children.amax(-1) < math.log(VANISHING_SIZE * self.context.extent)  # [N]
        event.volume_threshold = math.exp(threshold)
        event.blocked_by_cap += blocked
        event.isotropic_resplit += int((selected & split_again).sum())
        event.vanished += int((selected & vanishing).sum())
        event.split_volume += self.split(
            refinement,
            selected,
            children[selected],
            self.volume_children,
            Cause.SPLIT_VOLUME,
            keep_parent=self.keep_parent,
            sampled=self.placement == "sampled",
        )

    def log_threshold(self, volumes: Tensor, strictness: float = 1.0) -> float:
        """log V_th for Gaussians with log volumes [N], ``strictness`` of the governor included."""
        if self.threshold_mode in ("absolute", "extent_relative"):
            ungoverned = math.log(self.volume_threshold)
            if self.threshold_mode == "extent_relative":
                ungoverned += 3 * math.log(self.context.extent)
        elif len(volumes) == 0:
            return math.inf
        else:
            ordered = volumes.sort().values
            ungoverned = quantile(ordered, self.volume_quantile)
            if self.threshold_mode == "auto":
                first, third = quantile(ordered, 0.25), quantile(ordered, 0.75)
                ungoverned = third + TUKEY_FENCE * (third - first)
        return ungoverned + self.governor_dimension * math.log(strictness)
