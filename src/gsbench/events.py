"""Records of refinements, and the causes of Gaussians. Loads no torch."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from enum import IntEnum
from typing import ClassVar

from gsbench.words import FORM


class Cause(IntEnum):
    """Cause of a Gaussian's existence, by its number in ``lineage.npz``."""

    INITIAL = 0
    CLONE = 1
    SPLIT_GRADIENT = 2
    SPLIT_VOLUME = 3
    RELOCATED = 4
    ADDED = 5

    @property
    def key(self) -> str:
        """The name of the cause in result files."""
        return self.name.lower()


FEWEST_ROUNDS = 5  # with fewer, a densifier has hardly acted
FEW_ROUNDS = (
    "{arm}: {rounds:n round} of refinement in {iterations} iterations, too few to judge a "
    "densifier: train longer, or shorten the schedule as a whole, as by train.steps_scaler=0.1."
)


def few_rounds(arm: str, rounds: int, iterations: int) -> str:
    """The warning that a training had fewer than `FEWEST_ROUNDS` rounds of refinement."""
    return FORM.format(FEW_ROUNDS, arm=arm, rounds=rounds, iterations=iterations)


@dataclass
class RefineEvent:
    """Counts of one refinement by cause.

    ``after`` is ``before`` plus the counts in ``GROWN`` minus the counts in ``PRUNED``. A split
    counts the Gaussians that it adds beyond the parent, which is one for two children.
    ``relocated`` dead Gaussians change no count (3DGS-MCMC). ``blocked_by_cap`` counts candidates
    that the budget refused. ``isotropic_resplit`` counts parents split by volume whose children are
    still above the threshold, so that the next refinement splits them again. ``vanished`` counts
    parents split by volume whose children are far smaller than a pixel.

    Under ``cap=governor``, ``target`` is the intended count, ``strictness`` the factor on the
    thresholds of growth, and ``cull`` the factor on the opacity below which Gaussians are pruned.
    """

    GROWN: ClassVar[tuple[str, ...]] = ("cloned", "split_gradient", "split_volume", "added")
    PRUNED: ClassVar[tuple[str, ...]] = ("pruned_opacity", "pruned_size")

    step: int
    before: int
    after: int = 0
    cloned: int = 0
    split_gradient: int = 0
    split_volume: int = 0
    added: int = 0
    relocated: int = 0
    pruned_opacity: int = 0
    pruned_size: int = 0
    blocked_by_cap: int = 0
    isotropic_resplit: int = 0
    vanished: int = 0
    opacity_reset: bool = False
    volume_threshold: float | None = None
    target: int | None = None
    strictness: float | None = None
    cull: float | None = None

    def balances(self) -> bool:
        """Return whether the counts explain ``after``."""
        grown = sum(getattr(self, name) for name in self.GROWN)
        return self.after == self.before + grown - sum(getattr(self, name) for name in self.PRUNED)

    @property
    def grew_or_was_blocked(self) -> bool:
        """True if this refinement wanted to grow; one that only resets opacities does not."""
        return self.blocked_by_cap > 0 or any(getattr(self, name) for name in self.GROWN)

    def as_dict(self) -> dict[str, object]:
        """The record for ``events.jsonl``, without unset and infinite values."""
        return {
            key: value
            for key, value in asdict(self).items()
            if value is not None and math.isfinite(value)
        }

    @staticmethod
    def count_names() -> tuple[str, ...]:
        """The names of fields that can be summed over a trial."""
        names = (f.name for f in fields(RefineEvent) if f.default is not None)
        return tuple(name for name in names if name not in ("step", "before", "after"))


def sum_events(events: Sequence[Mapping[str, int]]) -> dict[str, int]:
    """The sum of each count over the records of ``events.jsonl``."""
    names = RefineEvent.count_names()
    return {name: sum(int(event.get(name, 0)) for event in events) for name in names}
