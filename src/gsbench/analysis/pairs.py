"""Pairs of trials of one scene and seed: all verdicts pair trials here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import takewhile

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.cells import check_averageable
from gsbench.analysis.differences import differing_conditions
from gsbench.analysis.notes import Note
from gsbench.analysis.quantities import asked_quantity, value_of
from gsbench.analysis.results import TrialPair, TrialResult, group_by, trials_of
from gsbench.errors import InputError
from gsbench.runs.commands import Question
from gsbench.runs.experiments import Arm

BASELINE = "adc"
SAME_CAPTURE = "same capture"  # the kind of a note

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ScenePairs:
    """The pairs of trials of one scene, one per seed, with both arms' values [K].

    Seeds are in the order in which they are added.
    """

    scene: str
    seeds: tuple[int, ...]
    trials: tuple[TrialPair, ...]
    baseline: Array
    arm: Array


@dataclass(frozen=True)
class Pairs:
    """The pairs of trials of a question by scene.

    ``left_out`` has a note on each thing that could not be paired.
    """

    rows: tuple[ScenePairs, ...]
    left_out: tuple[Note, ...] = ()
    relative: bool = False  # compare logarithms

    @property
    def seeds(self) -> int:
        """The number of seeds that all scenes have."""
        return min((len(row.seeds) for row in self.rows), default=0)

    @cached_property
    def differences(self) -> Array:
        """Arm minus baseline [S, K]; the logarithm of their ratio if ``relative``.

        Seeds that some scenes lack are dropped, so that all scenes weigh the same.
        """
        changes = [
            np.log(row.arm / row.baseline) if self.relative else row.arm - row.baseline
            for row in self.rows
        ]
        return np.array([change[: self.seeds] for change in changes])

    @property
    def baseline(self) -> float:
        """The baseline's mean over the same trials, in the metric's own unit."""
        return float(np.mean([row.baseline[: self.seeds].mean() for row in self.rows]))

    @property
    def counting(self) -> tuple[TrialPair, ...]:
        """The pairs that count, scene by scene."""
        return tuple(pair for row in self.rows for pair in row.trials[: self.seeds])

    @property
    def sides(self) -> tuple[list[TrialResult], list[TrialResult]]:
        """The baseline's trials that count, and their partners of the arm."""
        return [one for one, _ in self.counting], [other for _, other in self.counting]

    @property
    def trials(self) -> tuple[TrialResult, ...]:
        """The trials that count, pair by pair."""
        return tuple(trial for pair in self.counting for trial in pair)

    def first(self, seeds: int) -> Pairs:
        """The pairs of the first ``seeds`` seeds of every scene."""
        parts = ("seeds", "trials", "baseline", "arm")
        rows = (
            replace(row, **{part: getattr(row, part)[:seeds] for part in parts})
            for row in self.rows
        )
        return replace(self, rows=tuple(rows))


def pair(
    trials: Sequence[TrialResult],
    question: Question,
    name: Callable[[TrialResult], str] = lambda trial: trial.digest,
) -> Pairs:
    """Pair the trials of a question, which has this ``name`` of a trial, by scene and seed.

    The result also says which trials cannot be compared. Trials are compared only under equal
    conditions. If seeds come in looks, those after the first missing one do not count: a seed that
    comes late cannot change what an earlier look saw. One capture under two names is one scene: its
    trainings would count twice.
    """
    by_side = group_by(trials, lambda trial: (trial.scene, name(trial)))
    rows, left_out = [], list[Note]()
    captures: dict[object, str] = {}
    for scene, names in question.digests.items():
        seeds = question.seeds[scene]
        first, second = (
            [trial for trial in by_side.get((scene, side), []) if trial.seed in seeds]
            for side in names
        )
        try:
            row, faults = _pair_scene(scene, first, second, question)
        except InputError as error:
            left_out.append(Note.of("unlike", text=str(error)))
            continue
        left_out += faults
        if not row.seeds:
            continue
        trial = row.trials[0][0]
        data = trial.record.hashes.get("data")
        known = captures.setdefault((data, trial.split) if data else scene, scene)
        if known == scene:
            rows.append(row)
        else:
            left_out.append(Note.of(SAME_CAPTURE, scene=scene, other=known))
    counts = [len(row.seeds) for row in rows] or [0]
    if (least := min(counts)) < max(counts):
        few = [row.scene for row in rows if len(row.seeds) == least]
        left_out.append(Note.of("uneven", least=least, scenes=few, most=max(counts)))
    return Pairs(tuple(rows), tuple(left_out), question.relative)


def pair_trials(trials: Sequence[TrialResult], baseline: Arm, arm: Arm) -> list[TrialPair]:
    """The pairs of trials of two arms, sorted by scene and seed, without regard to metrics."""
    pairs: list[TrialPair] = []
    for scene, own in sorted(group_by(trials, "scene").items()):
        sides = trials_of(own, baseline), trials_of(own, arm)
        seeds = sorted({trial.seed for side in sides for trial in side})
        with suppress(InputError):  # the verdict on these arms reports it
            pairs += _match_seeds(scene, *sides, seeds).values()
    return pairs


def _match_seeds(
    scene: str,
    baseline: Sequence[TrialResult],
    arm: Sequence[TrialResult],
    seeds: Sequence[int],
    budgets: bool = True,
    code: bool = True,
) -> dict[int, TrialPair]:
    """The pairs of one scene by seed, in the order of ``seeds``.

    Raises InputError if trials of one arm cannot be averaged, or if the arms' conditions
    differ; ``budgets`` and ``code`` are conditions if they are asked for.
    """
    for own in (baseline, arm):
        if own:
            check_averageable(own, f"scene={scene} {own[0].arm}")
    one, other = ({trial.seed: trial for trial in own} for own in (baseline, arm))
    pairs = {seed: (one[seed], other[seed]) for seed in seeds if seed in one and seed in other}
    if pairs:
        differing = differing_conditions([*baseline, *arm], code=code)
        if not budgets:
            differing.pop("budget", None)
        if differing:
            raise InputError(str(Note.of("conditions", scene=scene, conditions=list(differing))))
    return pairs


def _pair_scene(
    scene: str, baseline: Sequence[TrialResult], arm: Sequence[TrialResult], question: Question
) -> tuple[ScenePairs, list[Note]]:
    """The pairs of one scene that have values, and a note on each thing that was not paired."""
    wanted = question.seeds[scene]
    # a claim may be about arms with different budgets, which its question then names
    pairs = _match_seeds(scene, baseline, arm, wanted, not question.name, not question.versions)
    values: dict[int, tuple[float, float]] = {}
    reasons: dict[str, list[str]] = {}
    for seed, trials in pairs.items():
        try:
            values[seed] = _values(question, *trials)
        except InputError as error:
            reasons.setdefault(str(error), []).append(f"{scene} seed {seed}")
    faults = [Note.of("valueless", places=own, reason=why) for why, own in reasons.items()]
    in_order = [*takewhile(values.__contains__, wanted)] if question.looks else [*values]
    of_baseline, of_arm = (np.array([values[seed][side] for seed in in_order]) for side in (0, 1))
    chosen = tuple(pairs[seed] for seed in in_order)
    return ScenePairs(scene, tuple(in_order), chosen, of_baseline, of_arm), faults


def _values(question: Question, baseline: TrialResult, arm: TrialResult) -> tuple[float, float]:
    asked = asked_quantity(question.metric, [baseline, arm])
    values = value_of(asked, baseline), value_of(asked, arm)
    if question.relative and min(values) <= 0:
        raise InputError(f"{asked.name} is {min(values):g}, and a ratio needs numbers above 0")
    return values


def are_equal(one: TrialResult, other: TrialResult) -> bool:
    """Return whether two trials have the same metrics and number of Gaussians."""
    same_count = one.record.num_gaussians == other.record.num_gaussians
    return bool(one.metrics) and one.metrics == other.metrics and same_count
