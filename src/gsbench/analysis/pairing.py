"""Pairs: `pair` finds the trials that a question compares, `choose_pairs` the arms that are held against each other.

`pair` is the only place that pairs trials; `gsbench.analysis.judgement.judge` says what the pairs say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import takewhile
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.cells import check_averageable
from gsbench.analysis.differences import differing_conditions
from gsbench.analysis.quantities import asked_quantity, value_of
from gsbench.analysis.results import TrialResult, by_key
from gsbench.errors import InputError
from gsbench.runs.declaration import Arm, Question
from gsbench.words import counted, some_of

BASELINE = "adc"
CONTROLS = "eval.controls."

Array = NDArray[np.float64]
TrialPair = tuple[TrialResult, TrialResult]  # of the baseline, and of the arm


@dataclass(frozen=True)
class ScenePairs:
    """The pairs of trials of one scene by seed, in the order in which seeds are added, with both arms' values [K]."""

    scene: str
    seeds: tuple[int, ...]
    trials: tuple[TrialPair, ...]
    before: Array
    after: Array

    def kept(self, places: Sequence[int]) -> ScenePairs:
        chosen = list(places)
        return ScenePairs(
            self.scene,
            tuple(self.seeds[k] for k in chosen),
            tuple(self.trials[k] for k in chosen),
            self.before[chosen],
            self.after[chosen],
        )


@dataclass(frozen=True)
class Pairs:
    """The trials that a question compares, scene by scene, and in one line each what could not be paired."""

    rows: tuple[ScenePairs, ...]
    left_out: tuple[str, ...] = ()
    relative: bool = False  # differences are of logarithms

    @property
    def scenes(self) -> tuple[str, ...]:
        return tuple(row.scene for row in self.rows)

    @property
    def seeds(self) -> int:
        """The number of seeds that all scenes have."""
        return min((len(row.seeds) for row in self.rows), default=0)

    @cached_property
    def differences(self) -> Array:
        """Arm minus baseline [S, K] over the seeds that all scenes have: further ones would weigh scenes unlike."""
        change = [np.log(row.after / row.before) if self.relative else row.after - row.before for row in self.rows]
        return np.array([values[: self.seeds] for values in change])

    @property
    def baseline(self) -> float:
        """The baseline's mean over the same trials, in the metric's own unit."""
        return float(np.mean([row.before[: self.seeds].mean() for row in self.rows]))

    @property
    def trials(self) -> tuple[TrialResult, ...]:
        """The trials that count, pair by pair."""
        return tuple(trial for row in self.rows for pair in row.trials[: self.seeds] for trial in pair)

    def first(self, seeds: int) -> Pairs:
        """The pairs of the first ``seeds`` seeds of every scene."""
        return replace(self, rows=tuple(row.kept(range(min(seeds, len(row.seeds)))) for row in self.rows))

    def without(self, outlying: Sequence[TrialResult]) -> Pairs:
        """The pairs of which neither trial is ``outlying``; a scene that has no other is left out."""
        paths = {trial.path for trial in outlying}
        rows = [
            row.kept([k for k, pair in enumerate(row.trials) if not paths & {one.path for one in pair}])
            for row in self.rows
        ]
        return replace(self, rows=tuple(row for row in rows if row.seeds))


def pair(trials: Sequence[TrialResult], question: Question) -> Pairs:
    """Pair the trials that a question compares by scene and seed, and say what has no partner or cannot be compared.

    Trials under unlike conditions are not compared; unlike budgets are no hindrance where the question names its
    trials itself, since a claim may be about arms with budgets of their own. Of seeds in planned order none beyond the
    first that is missing counts: one that comes late never changes what an earlier look saw.
    """
    rows, left_out = [], list[str]()
    for scene, sides in _sides(trials, question).items():
        try:
            row, faults = _row(scene, *sides, question)
        except InputError as error:
            left_out.append(str(error))
            continue
        left_out += faults
        rows += [row] if row.seeds else []
    if uneven := {len(row.seeds) for row in rows if len(row.seeds) > min(len(row.seeds) for row in rows)}:
        least = min(len(row.seeds) for row in rows)
        few = some_of([row.scene for row in rows if len(row.seeds) == least])
        left_out.append(
            f"{counted(least, 'seed')} of each scene count, since {few} has no more (others up to {max(uneven)})"
        )
    return Pairs(tuple(rows), tuple(left_out), question.relative)


def _sides(trials: Sequence[TrialResult], question: Question) -> dict[str, tuple[list[TrialResult], list[TrialResult]]]:
    """The trials of the baseline and of the arm by scene."""
    if question.scenes:
        by_folder = by_key(trials, lambda trial: trial.key)
        return {
            scene: (by_folder.get(one, []), by_folder.get(other, [])) for scene, (one, other) in question.scenes.items()
        }
    return {
        scene: ([t for t in own if t.arm == question.baseline], [t for t in own if t.arm == question.arm])
        for scene, own in by_key(trials, lambda trial: trial.scene).items()
    }


def pair_trials(trials: Sequence[TrialResult], baseline: Arm, arm: Arm) -> list[TrialPair]:
    """The pairs of trials of two arms, sorted by scene and seed, whatever their metrics are."""
    question = Question(metric="", baseline=baseline, arm=arm)
    found: list[TrialPair] = []
    for scene, sides in sorted(_sides(trials, question).items()):
        with suppress(InputError):  # said where the arms are judged
            found += _matched(scene, *sides, question)[0].values()
    return found


def _matched(
    scene: str, baseline: Sequence[TrialResult], arm: Sequence[TrialResult], question: Question
) -> tuple[dict[int, TrialPair], list[str]]:
    """The pairs of one scene by seed, in the planned order, and the seeds that have no partner.

    Raises InputError where trials of one arm cannot be averaged, or the arms' conditions are unlike.
    """
    for own in (baseline, arm):
        if own:
            check_averageable(own, f"scene={scene} {own[0].arm}")
    one, other = ({trial.seed: trial for trial in own} for own in (baseline, arm))
    wanted = question.seeds or sorted(one.keys() | other.keys())
    both = {seed: (one[seed], other[seed]) for seed in wanted if seed in one and seed in other}
    if both:
        differing = differing_conditions([*baseline, *arm], code=not question.versions)
        if question.scenes:
            differing.pop("budget", None)
        if differing:
            raise InputError(f"{scene}: the arms differ in {', '.join(differing)}, so they are not compared")
    alone = () if question.seeds else tuple(seed for seed in wanted if seed not in both)
    return both, [f"{scene}: seed {seed} has no partner" for seed in alone]


def _row(
    scene: str, baseline: Sequence[TrialResult], arm: Sequence[TrialResult], question: Question
) -> tuple[ScenePairs, list[str]]:
    both, faults = _matched(scene, baseline, arm, question)
    values: dict[int, tuple[float, float]] = {}
    reasons: dict[str, list[str]] = {}
    for seed, trials in both.items():
        try:
            values[seed] = _values(question, *trials)
        except InputError as error:
            reasons.setdefault(str(error), []).append(f"{scene} seed {seed}")
    faults += [f"{some_of(places)}: {reason}" for reason, places in reasons.items()]
    seeds = list(takewhile(values.__contains__, question.seeds)) if question.seeds else list(values)
    before, after = (np.array([values[seed][side] for seed in seeds]) for side in (0, 1))
    return ScenePairs(scene, tuple(seeds), tuple(both[seed] for seed in seeds), before, after), faults


def _values(question: Question, one: TrialResult, other: TrialResult) -> tuple[float, float]:
    asked = asked_quantity(question.metric, [one, other])
    before, after = value_of(asked, one), value_of(asked, other)
    if question.relative and min(before, after) <= 0:
        raise InputError(f"{asked.name} is {min(before, after):g}, and a ratio needs numbers above 0")
    return before, after


def choose_pairs(
    arms: Sequence[Arm], baseline: str = BASELINE, controls: Mapping[str, str] = MappingProxyType({})
) -> list[tuple[Arm, Arm]]:
    """(baseline arm, other arm) for every densifier whose initialiser also has the baseline, then those of controls.

    An arm with swept settings is held against the baseline with the same ones where there is one. Without the baseline,
    the other arms are held against the first of ``arms``. ``controls`` names for a densifier another one that it is
    held against besides (`controls_of`), where both are there.
    """

    def partners(arm: Arm, densify: str) -> list[Arm]:
        alike = replace(arm, densify=densify)
        return [one for one in (alike, replace(alike, variant=())) if one in arms]

    pairs = [(found[0], arm) for arm in arms if arm.densify != baseline and (found := partners(arm, baseline))]
    pairs = pairs or [(arms[0], arm) for arm in arms[1:]]
    for arm in arms:
        control = controls.get(arm.densify, arm.densify)
        found = [] if control == arm.densify else partners(arm, control)
        if found and (found[0], arm) not in pairs:
            pairs.append((found[0], arm))
    return pairs


def controls_of(trials: Sequence[TrialResult]) -> dict[str, str]:
    """The control of each densifier, another one that the trials' settings name (``eval.controls``)."""
    firsts = [group[0] for group in by_key(trials, lambda trial: trial.arm).values()]
    return {
        key.removeprefix(CONTROLS): str(value)
        for trial in firsts
        for key, value in trial.config.items()
        if key.startswith(CONTROLS)
    }
