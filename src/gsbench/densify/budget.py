"""Limits on the number of Gaussians: the arithmetic of all caps, and the base of densifiers that have one."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from pydantic import NonNegativeInt, PositiveInt
from torch import Tensor

from gsbench.densify.base import Densifier, DensifyContext, Refinement, Rule
from gsbench.errors import InputError
from gsbench.gaussians.model import Gaussians

CapKind = Literal["soft", "freeze", "hard", "curve", "governor"]
SETTLE_STEPS = 40  # halvings of a range of the logarithm: far below the distance of neighbouring float32 scores


def check_room(most: int, num_initial: int) -> None:
    """Raise InputError where the initial cloud has more Gaussians than an arm may ever have."""
    if most < num_initial:
        raise InputError(
            f"densify.max_gaussians must be at least the size of the initial cloud ({num_initial}), got {most}"
        )


def limit_at(step: int, start: int, stop: int, initial: int, max_gaussians: int | None, cap: CapKind) -> int | None:
    """The cap that holds at iteration ``step``.

    ``curve`` rises from the ``initial`` count at ``start`` to ``max_gaussians`` at ``stop`` along n0 + (n - n0) (2x -
    x^2), so that arms grow alike and the last refinements are small (the idea of Taming 3DGS, arXiv 2406.15643).
    """
    if max_gaussians is None or cap != "curve":
        return max_gaussians
    x = min(max((step - start) / (stop - start), 0.0), 1.0)
    return round(initial + (max_gaussians - initial) * (2 * x - x * x))


def allowance(num_gaussians: int, max_gaussians: int | None, cap: CapKind) -> int | None:
    """The number of Gaussians that a growth step may add; None for no limit.

    ``soft``: no limit up to ``max_gaussians``, nothing beyond it, so one step may overshoot (the paper's cap, whose
    counts end at 3.41 to 3.57 M for 3.4 M). ``hard`` and ``curve``: never beyond it. ``freeze`` and ``governor`` set no
    limit within a round.
    """
    if max_gaussians is None or cap in ("freeze", "governor"):
        return None
    if cap == "soft":
        return None if num_gaussians <= max_gaussians else 0
    return max(0, max_gaussians - num_gaussians)


def admit(candidates: Tensor, score: Tensor, gain: int, allowed: int | None) -> tuple[Tensor, int]:
    """The candidates that the allowance admits, best ``score`` first (ties by index), and how many it refused.

    ``candidates`` is a mask [N], ``score`` [N]; each candidate adds ``gain`` Gaussians.
    """
    count = int(candidates.sum())
    if allowed is None or count * gain <= allowed:
        return candidates, 0
    places = allowed // gain if gain > 0 else count
    index = candidates.nonzero().squeeze(-1)  # [C]
    best = index[torch.sort(score[index], descending=True, stable=True).indices[:places]]
    admitted = torch.zeros_like(candidates)
    admitted[best] = True
    return admitted, count - places


def settle(count: Callable[[float], int], target: int, low: float, high: float) -> float:
    """The factor in [``low``, ``high``] at which ``count``, which falls with it, is nearest to ``target`` from below;
    ``high`` where it never falls so far."""
    if count(low) <= target:
        return low
    a, b = math.log(low), math.log(high)
    for _ in range(SETTLE_STEPS):
        middle = (a + b) / 2
        reached = count(math.exp(middle))
        if reached == target:
            return math.exp(middle)
        a, b = (middle, b) if reached > target else (a, middle)
    return min(high, math.exp(b))


PAPER_CAP = 3_400_000  # the paper's, for the baseline and its own rule alike
STRICTNESS_LIMITS = (1e-3, 1e3)  # of the factor on the thresholds of growth
CULL_LIMITS = (1.0, 10.0)  # of the factor on the opacity below which Gaussians are pruned
DEADBAND = 0.01  # so far above its target a count is not culled (the paper of the governor: "e.g., 1%")


@dataclass
class Budgeted(Densifier):
    """Base of densifiers that have rounds of growth and pruning, and a limit on their Gaussians.

    ``cap`` says how ``max_gaussians`` is kept:

    - ``soft``: nothing grows in a round that starts beyond it, pruning goes on;
    - ``freeze``: such a round neither grows nor prunes;
    - ``hard``: the candidates of the highest score are taken up to it, never more;
    - ``curve``: as ``hard``, with a limit that rises to it over the window;
    - ``governor``: the thresholds are moved so that the count follows that curve and ends at it (`govern`).

    With ``soft`` and ``hard`` the training may have a limit of its own for each round (``train.resolution_schedule``).

    A subclass asks `allowance` for the first four. For ``freeze`` and ``governor`` it says, by ``forecast``, what count
    a round would lead to, and multiplies its own thresholds by ``strictness`` and its opacity cull by ``cull``.

    Examples:
        Clones what is opaque, under any cap:

        >>> @dataclass
        ... class CloneOpaque(Budgeted):
        ...     def opaque(self, refinement):
        ...         return refinement.gaussians.values.opacities > 0.5 * self.strictness
        ...
        ...     def forecast(self, refinement):
        ...         return len(refinement.gaussians) + int(self.opaque(refinement).sum())
        ...
        ...     def rules(self, refinement):
        ...         return [*self.governing(), self.grow] if self.due(refinement.step) else []
        ...
        ...     def grow(self, refinement):
        ...         opaque = self.opaque(refinement)
        ...         admitted, _ = admit(opaque, opaque.float(), 1, self.allowance(refinement))
        ...         refinement.event.cloned += self.clone(refinement, admitted)

        >>> CloneOpaque(cap="governor", max_gaussians=1000).due(600)
        True
    """

    start: NonNegativeInt = 500  # a round where start < step < stop and step % interval == 0
    stop: int = 15_000
    interval: PositiveInt = 100
    max_gaussians: PositiveInt | None = PAPER_CAP  # None: no limit, as 3DGS
    cap: CapKind = "soft"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stop <= self.start:
            raise InputError(f"densify.stop must be above densify.start ({self.start}), got {self.stop}")
        if self.cap in ("freeze", "curve", "governor") and self.max_gaussians is None:
            raise InputError(f"densify.max_gaussians must be set for densify.cap={self.cap}")
        if self.cap in ("freeze", "governor") and type(self).forecast is Budgeted.forecast:
            raise InputError(f"densify.cap={self.cap} needs the method forecast, which {type(self).__name__} lacks")

    def begin(self, gaussians: Gaussians, context: DensifyContext) -> None:
        if self.most_gaussians is not None:
            check_room(self.most_gaussians, len(gaussians))
        super().begin(gaussians, context)

    def due(self, step: int) -> bool:
        """Return whether a round of growth and pruning is due."""
        return self.start < step < self.stop and step % self.interval == 0

    def allowance(self, refinement: Refinement) -> int | None:
        """The number of Gaussians that may be added now; None for no limit."""
        initial = self.lineage.initial_count
        limit = limit_at(refinement.step, self.start, self.stop, initial, self.max_gaussians, self.cap)
        count = len(refinement.gaussians)
        allowed = allowance(count, limit, self.cap)
        if self.context.limit is None or self.cap not in ("soft", "hard"):
            return allowed
        most = self.context.limit(refinement, self.max_gaussians if self.cap == "hard" else None)
        return max(0, most - count) if allowed is None else max(0, min(allowed, most - count))

    def forecast(self, refinement: Refinement) -> int:
        """The number of Gaussians that there would be after a round with the present ``strictness`` and ``cull``."""
        raise NotImplementedError

    def frozen(self, refinement: Refinement) -> bool:
        """Return whether this round is left out because the count is beyond the limit (``cap=freeze``)."""
        over = self.max_gaussians is not None and len(refinement.gaussians) > self.max_gaussians
        return self.cap == "freeze" and over

    def governing(self) -> list[Rule]:
        """The rules that a round starts with: `govern`, where that is the cap."""
        return [self.govern] if self.cap == "governor" else []

    def stand_still(self, refinement: Refinement) -> None:
        """The only rule of a frozen round: say how many Gaussians it would have added."""
        refinement.event.blocked_by_cap += self._forecast_at(refinement) - self._forecast_at(refinement, math.inf)

    def govern(self, refinement: Refinement) -> None:
        """The first rule of a governed round: set ``strictness`` and ``cull`` so that it ends at the curve's count.

        From Bisht and Kolb, "Smart Target Point Control for Gaussian Splatting Methods" (arXiv 2605.16158): the target
        n0 + (n - n0) (2x - x^2) (their eq. 3 to 5); only the thresholds of growth and the opacity cull move; below the
        target the cull is at its own value, above it growth is at its strictest and the cull rises; a deadband; no
        raised cull for some time after an opacity reset (eq. 13).

        Ours: the curve ends at the last round, x = 1; one factor for all thresholds of growth; and it is not stepped
        towards the quota by a bounded update (eq. 8 to 12, whose gains are not stated) but is the one at which
        ``forecast`` meets the target, found by bisection, so that a window of ten rounds is followed as well as one of
        144.
        """
        event = refinement.event
        target = self.target(refinement)
        free = self._forecast_at(refinement)
        self.strictness = settle(lambda s: self._forecast_at(refinement, s), target, *STRICTNESS_LIMITS)
        reached = self._forecast_at(refinement, self.strictness)
        if reached > (1 + DEADBAND) * target and self.may_cull(refinement.step):
            self.cull = settle(lambda c: self._forecast_at(refinement, self.strictness, c), target, *CULL_LIMITS)
        event.target, event.strictness, event.cull = target, self.strictness, self.cull
        event.blocked_by_cap += max(0, free - reached)

    def target(self, refinement: Refinement) -> int:
        """The count that a governed round is to end at; that of the last round is ``max_gaussians``.

        A round closes the share of what is missing that the curve closes at its place, ((1 - x0)^2 - (1 - x)^2) / (1 -
        x0)^2 for progress x0 before and x after it: on the curve that is the curve, and an arm that fell behind catches
        up little by little.
        """
        assert self.max_gaussians is not None  # __post_init__ asks for it
        last = (self.stop - 1) // self.interval
        left, ahead = last - refinement.step // self.interval, last - self.start / self.interval  # rounds
        before = min(left + 1, ahead)
        count = len(refinement.gaussians)
        return count + round((self.max_gaussians - count) * (1 - (left / before) ** 2))

    def may_cull(self, step: int) -> bool:
        """Return whether opacities mean something now; not soon after they were reset."""
        return True

    def _forecast_at(self, refinement: Refinement, strictness: float = 1.0, cull: float = 1.0) -> int:
        self.strictness, self.cull = strictness, cull
        return self.forecast(refinement)
