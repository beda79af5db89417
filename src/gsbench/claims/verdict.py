"""The verdict on one claim: supported, refuted, undecided, or not testable here, with all that it rests on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.declaration import measured
from gsbench.analysis.differences import differing_conditions
from gsbench.analysis.results import TrialResult
from gsbench.analysis.statistics import Interval
from gsbench.claims.file import Claim
from gsbench.claims.measures import Measure, find_measure, read_measure
from gsbench.claims.sequential import Decision, Design, decide
from gsbench.errors import InputError
from gsbench.words import counted, signed, some_of

Word = Literal["supported", "refuted", "undecided", "not testable here"]
NOT_TESTABLE: Word = "not testable here"
ALLOWED_TO_DIFFER = ("budget",)  # of two arms' conditions: a claim may be about arms with budgets of their own

PairKey = tuple[str, int]  # scene, seed
Pair = tuple[TrialResult, TrialResult]  # baseline, arm


class Planner(Protocol):
    """Planner of the looks at a claim: a file of claims, or a sweep."""

    def design(self, claim: Claim, scenes: int, sharing: int) -> Design: ...


@dataclass(frozen=True)
class Verdict:
    """One claim's verdict.

    ``decision`` is None where nothing could be tested, as where the arms are one and the same at this size.
    ``baseline`` is the baseline's mean in the measure's own unit. ``trials`` are those that the decision rests on,
    pair by pair; ``notes`` say what was left out and why.
    ``beforehand``: none of them was measured before the plan was declared.
    """

    claim: Claim
    word: Word
    reason: str
    measure: Measure
    design: Design | None = None
    decision: Decision | None = None
    by_scene: tuple[tuple[str, float], ...] = ()
    baseline: float | None = None
    trials: tuple[TrialResult, ...] = ()
    notes: tuple[str, ...] = ()
    beforehand: bool = True

    def shown(self, value: float) -> str:
        """A difference, in the scale in which trials are compared, as people read it: ``−0.0123`` or ``+28.4 %``."""
        if self.claim.effect.relative:
            return f"{signed(100 * math.expm1(value), '.1f')} %"
        return signed(value, f".{self.measure.decimals + 1}f")

    def shown_interval(self, interval: Interval) -> str:
        return f"{self.shown(interval.low)} to {self.shown(interval.high)}"


def judge_claim(
    claim: Claim,
    planner: Planner,
    pairs: Mapping[PairKey, Pair],
    scenes: Sequence[str],
    sharing: int = 1,
    declared_at: float | None = None,
) -> Verdict:
    """The verdict of a claim from its pairs of trials by scene and seed.

    ``scenes`` are those that can be run here, ``sharing`` is how many tests share the error rate. Where trials
    were measured before ``declared_at`` (Unix time), when the plan was written down, the claim's metric is one of all
    that were measured, and has its part of the error rate alone.
    """
    both = [trial for pair in pairs.values() for trial in pair]
    measure = find_measure(claim.metric, both)
    if claim.not_testable:
        return Verdict(claim, NOT_TESTABLE, claim.not_testable, measure)
    if not scenes:
        return Verdict(claim, NOT_TESTABLE, "none of its scenes is here", measure)
    differences, bases, faults = _differences(claim, pairs, measure)
    if pairs and not differences:
        return Verdict(claim, NOT_TESTABLE, faults[0], measure, notes=tuple(faults[1:]))
    if pairs and all(map(_is_equal, pairs.values())):
        reason = (
            f"both arms of {counted(len(pairs), 'pair')} of trials are equal to the last bit: what they differ in "
            "never acted at this size"
        )
        trials = tuple(trial for key in sorted(pairs) for trial in pairs[key])
        return Verdict(claim, NOT_TESTABLE, reason, measure, trials=trials, notes=tuple(faults))
    late = 0 if declared_at is None else sum(measured(trial) < declared_at for trial in both)
    if late:
        names = {name for trial in both for name in trial.metrics} | {claim.metric}
        sharing *= len(names)
        faults.append(
            f"{counted(late, 'trial')} had been measured before this plan was declared: the metric is one of "
            f"{len(names)} that could have been chosen, which share the error rate"
        )
    design = planner.design(claim, len(scenes), sharing)
    rows = [_unbroken(scene, differences, design.looks[-1]) for scene in scenes]  # [S] of [K]
    decision = decide(rows, design, claim.effect.margin, claim.sign)
    seen = {(scene, seed) for scene in scenes for seed in range(decision.seeds)}
    return Verdict(
        claim,
        _word(decision, claim),
        _reason(decision, claim, rows, scenes),
        measure,
        design,
        decision,
        tuple((scene, float(row[: decision.seeds].mean())) for scene, row in zip(scenes, rows, strict=True) if seen),
        float(np.mean([bases[key] for key in seen])) if seen else None,
        tuple(trial for key in sorted(seen) for trial in pairs[key]),
        tuple(faults),
        not late,
    )


def _is_equal(pair: Pair) -> bool:
    """Return whether the two models are one and the same, as far as numbers tell."""
    one, other = pair
    same_count = one.record.num_gaussians == other.record.num_gaussians
    return bool(one.metrics) and one.metrics == other.metrics and same_count


def _differences(
    claim: Claim, pairs: Mapping[PairKey, Pair], measure: Measure
) -> tuple[dict[PairKey, float], dict[PairKey, float], list[str]]:
    """Arm minus baseline of every pair that can be compared, the baseline's value, and why others cannot."""
    found: dict[PairKey, float] = {}
    bases: dict[PairKey, float] = {}
    faults: dict[str, list[str]] = {}
    for (scene, seed), (one, other) in sorted(pairs.items()):
        try:
            differing = [key for key in differing_conditions([one, other]) if key not in ALLOWED_TO_DIFFER]
            if differing:
                raise InputError(f"the arms differ in {', '.join(differing)}, so they are not compared")
            base, value = (read_measure(measure, trial) for trial in (one, other))
            if claim.effect.relative and min(base, value) <= 0:
                raise InputError(f"{measure.name} is {min(base, value):g}, of which no ratio can be taken")
        except InputError as error:
            faults.setdefault(str(error), []).append(f"{scene} seed {seed}")
            continue
        found[scene, seed] = math.log(value / base) if claim.effect.relative else value - base
        bases[scene, seed] = base
    return found, bases, [f"{some_of(places)}: {reason}" for reason, places in faults.items()]


def _unbroken(scene: str, differences: Mapping[PairKey, float], most: int) -> NDArray[np.float64]:
    """The scene's differences from seed 0 up to the first that is missing.

    A seed that comes late, after a retry, so never changes what an earlier look saw.
    """
    seeds = list(takewhile(lambda seed: (scene, seed) in differences, range(most)))
    return np.array([differences[scene, seed] for seed in seeds], dtype=float)


def _word(decision: Decision, claim: Claim) -> Word:
    """Supported, refuted or undecided; a claim of no difference is supported where any effect is too small."""
    if decision.outcome == "equivalent":
        return "refuted" if claim.sign else "supported"
    return "supported" if decision.outcome == "for" else "refuted" if decision.outcome == "against" else "undecided"


def _reason(decision: Decision, claim: Claim, rows: Sequence[NDArray[np.float64]], scenes: Sequence[str]) -> str:
    """In a few words, why the verdict is what it is."""
    least = claim.effect
    if decision.outcome == "equivalent":
        return f"any effect is smaller than the least that matters ({least})"
    if decision.outcome == "for":
        assert decision.interval is not None
        smallest = decision.interval.low if claim.sign > 0 else -decision.interval.high
        return f"it is {claim.direction}" + (
            "" if smallest >= least.margin else f"; whether by {least} or more is open"
        )
    if decision.outcome == "against":
        return f"it is not {claim.direction} but the contrary" if claim.sign else f"it differs by more than {least}"
    if decision.outcome == "undecided":
        return f"after all {decision.seeds} seeds neither a difference nor its being below {least} is sure"
    waiting = [scene for scene, row in zip(scenes, rows, strict=True) if len(row) == min(map(len, rows))]
    return f"trials are missing: the next look waits for {some_of(waiting)}"
