"""Pairs of trials (`pair`, of one scene and seed) and pairs of arms (`choose_pairs`).

All verdicts pair trials here; `gsbench.analysis.judgement.judge` decides what the pairs show.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import takewhile
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.cells import check_averageable
from gsbench.analysis.differences import differing_conditions
from gsbench.analysis.notes import Note
from gsbench.analysis.quantities import asked_quantity, value_of
from gsbench.analysis.results import TrialPair, TrialResult, group_by
from gsbench.analysis.trial_settings import Configured
from gsbench.errors import InputError
from gsbench.runs.experiments import Arm, Question

BASELINE = "adc"
CONTROLS = "eval.controls."
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

    def subset(self, indices: Sequence[int]) -> ScenePairs:
        chosen = list(indices)
        return ScenePairs(
            self.scene,
            tuple(self.seeds[k] for k in chosen),
            tuple(self.trials[k] for k in chosen),
            self.baseline[chosen],
            self.arm[chosen],
        )


@dataclass(frozen=True)
class Pairs:
    """The pairs of trials of a question by scene.

    ``left_out`` has a note on each thing that could not be paired.
    """

    rows: tuple[ScenePairs, ...]
    left_out: tuple[Note, ...] = ()
    relative: bool = False  # compare logarithms

    @property
    def scenes(self) -> tuple[str, ...]:
        return tuple(row.scene for row in self.rows)

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
    def of_baseline(self) -> tuple[TrialResult, ...]:
        """The baseline's trials that count."""
        return tuple(baseline for baseline, _ in self.counting)

    @property
    def of_arm(self) -> tuple[TrialResult, ...]:
        """The arm's trials that count, each in the place of its partner in `of_baseline`."""
        return tuple(arm for _, arm in self.counting)

    @property
    def trials(self) -> tuple[TrialResult, ...]:
        """The trials that count, pair by pair."""
        return tuple(trial for pair in self.counting for trial in pair)

    def first(self, seeds: int) -> Pairs:
        """The pairs of the first ``seeds`` seeds of every scene."""
        return replace(
            self, rows=tuple(row.subset(range(min(seeds, len(row.seeds)))) for row in self.rows)
        )

    def without(self, outlying: Sequence[TrialResult]) -> Pairs:
        """The pairs without those of an ``outlying`` trial; a scene without pairs is left out."""
        paths = {trial.path for trial in outlying}
        rows = [
            row.subset(
                [
                    k
                    for k, pair in enumerate(row.trials)
                    if not paths & {trial.path for trial in pair}
                ]
            )
            for row in self.rows
        ]
        return replace(self, rows=tuple(row for row in rows if row.seeds))


def pair(trials: Sequence[TrialResult], question: Question) -> Pairs:
    """Pair the trials of a question by scene and seed.

    The result also says which trials have no partner or cannot be compared. Trials are compared
    only under equal conditions. Budgets may differ if the question names its trials itself,
    since a claim may be about arms with different budgets. If the seeds have a planned order,
    those after the first missing seed do not count: a seed that comes late cannot change what
    an earlier look saw. One capture under two names is one scene: its trainings would count twice.
    """
    rows, left_out = [], list[Note]()
    captures: dict[object, str] = {}
    for scene, sides in _sides(trials, question).items():
        try:
            row, faults = _pair_scene(scene, *sides, question)
        except InputError as error:
            left_out.append(Note.of("unlike", text=str(error)))
            continue
        left_out += faults
        if not row.seeds:
            continue
        first = row.trials[0][0]
        data = first.record.hashes.get("data")
        known = captures.setdefault((data, first.split) if data else scene, scene)
        if known == scene:
            rows.append(row)
        else:
            left_out.append(Note.of(SAME_CAPTURE, scene=scene, other=known))
    if uneven := {
        len(row.seeds) for row in rows if len(row.seeds) > min(len(row.seeds) for row in rows)
    }:
        least = min(len(row.seeds) for row in rows)
        few = [row.scene for row in rows if len(row.seeds) == least]
        left_out.append(Note.of("uneven", least=least, scenes=few, most=max(uneven)))
    return Pairs(tuple(rows), tuple(left_out), question.relative)


def _sides(
    trials: Sequence[TrialResult], question: Question
) -> dict[str, tuple[list[TrialResult], list[TrialResult]]]:
    """The trials of the baseline and of the arm, by scene."""
    if question.scenes:
        by_folder = group_by(trials, lambda trial: trial.key)
        return {
            scene: (by_folder.get(one, []), by_folder.get(other, []))
            for scene, (one, other) in question.scenes.items()
        }
    return {
        scene: (
            [t for t in own if t.arm == question.baseline],
            [t for t in own if t.arm == question.arm],
        )
        for scene, own in group_by(trials, lambda trial: trial.scene).items()
    }


def pair_trials(trials: Sequence[TrialResult], baseline: Arm, arm: Arm) -> list[TrialPair]:
    """The pairs of trials of two arms, sorted by scene and seed, without regard to metrics."""
    question = Question(metric="", baseline=baseline, arm=arm)
    pairs: list[TrialPair] = []
    for scene, sides in sorted(_sides(trials, question).items()):
        with suppress(InputError):  # the verdict on these arms reports it
            pairs += _match_seeds(scene, *sides, question)[0].values()
    return pairs


def _match_seeds(
    scene: str, baseline: Sequence[TrialResult], arm: Sequence[TrialResult], question: Question
) -> tuple[dict[int, TrialPair], list[Note]]:
    """The pairs of one scene by seed, in the planned order, and a note for each unpaired seed.

    Raises InputError if trials of one arm cannot be averaged, or if the arms' conditions
    differ.
    """
    for own in (baseline, arm):
        if own:
            check_averageable(own, f"scene={scene} {own[0].arm}")
    baseline_by_seed, arm_by_seed = (
        {trial.seed: trial for trial in own} for own in (baseline, arm)
    )
    wanted = question.seeds or sorted(baseline_by_seed.keys() | arm_by_seed.keys())
    shared = baseline_by_seed.keys() & arm_by_seed.keys()
    pairs = {seed: (baseline_by_seed[seed], arm_by_seed[seed]) for seed in wanted if seed in shared}
    if pairs:
        differing = differing_conditions([*baseline, *arm], code=not question.versions)
        if question.scenes:
            differing.pop("budget", None)
        if differing:
            raise InputError(str(Note.of("conditions", scene=scene, conditions=list(differing))))
    unpaired = () if question.seeds else tuple(seed for seed in wanted if seed not in pairs)
    return pairs, [Note.of("unpaired", scene=scene, seed=seed) for seed in unpaired]


def _pair_scene(
    scene: str, baseline: Sequence[TrialResult], arm: Sequence[TrialResult], question: Question
) -> tuple[ScenePairs, list[Note]]:
    """The pairs of one scene that have values, and a note on each thing that was not paired."""
    pairs, faults = _match_seeds(scene, baseline, arm, question)
    values: dict[int, tuple[float, float]] = {}
    reasons: dict[str, list[str]] = {}
    for seed, trials in pairs.items():
        try:
            values[seed] = _values(question, *trials)
        except InputError as error:
            reasons.setdefault(str(error), []).append(f"{scene} seed {seed}")
    faults += [Note.of("valueless", places=own, reason=why) for why, own in reasons.items()]
    counted_seeds = (
        list(takewhile(values.__contains__, question.seeds)) if question.seeds else list(values)
    )
    of_baseline, of_arm = (
        np.array([values[seed][side] for seed in counted_seeds]) for side in (0, 1)
    )
    chosen = tuple(pairs[seed] for seed in counted_seeds)
    return ScenePairs(scene, tuple(counted_seeds), chosen, of_baseline, of_arm), faults


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


def choose_pairs(
    arms: Sequence[Arm],
    baseline: str = BASELINE,
    controls: Mapping[str, str] = MappingProxyType({}),
    settings: Mapping[Arm, Mapping[str, Any]] = MappingProxyType({}),
    ages: Mapping[Arm, float] = MappingProxyType({}),
) -> list[tuple[Arm, Arm]]:
    """The pairs (baseline, arm) of arms to compare: those with the baseline, then with controls.

    An arm is compared with every arm that has the baseline densifier, the same initialiser, and
    the same values of the swept settings that both have. If there is none, it is compared with
    those that share most of these values. So a further arm never takes another arm's baseline
    away. If no arm can be compared in this way, all are compared with the oldest of ``arms`` by
    ``ages``, the times of their first results; of equal ones, with the first.

    ``controls`` maps a densifier to a further one that it is compared with (`controls_of`).
    ``settings`` are the arms' configurations, for swept settings that are not in an arm's name.
    """

    def partners(arm: Arm, densify: str) -> list[Arm]:
        found = [other for other in arms if (other.init, other.densify) == (arm.init, densify)]
        unlike = {other: _unlike(arm, other, settings) for other in found}
        return [other for other in found if unlike[other] == min(unlike.values())]

    pairs = [
        (one, arm) for arm in arms if arm.densify != baseline for one in partners(arm, baseline)
    ]
    if not pairs and arms:
        oldest = min(arms, key=lambda arm: ages.get(arm, 0.0))
        pairs = [(oldest, arm) for arm in arms if arm != oldest]
    for arm in arms:
        control = controls.get(arm.densify, arm.densify)
        if control != arm.densify:
            pairs += [
                (partner, arm) for partner in partners(arm, control) if (partner, arm) not in pairs
            ]
    return pairs


def baseline_settings(
    arms: Sequence[Arm], ages: Mapping[Arm, float], baseline: str = BASELINE
) -> list[tuple[Arm, Arm]]:
    """The pairs of the baseline's own settings and initialisers: the oldest, and each other.

    Settings are compared within an initialiser. All this is compared whatever other arms there are,
    so that a further arm takes no verdict away.
    """
    of_baseline = [arm for arm in arms if arm.densify == baseline]
    by_init = group_by(
        sorted(of_baseline, key=lambda arm: ages.get(arm, 0.0)), lambda arm: arm.init
    )
    oldest = [own[0] for own in by_init.values()]
    pairs = [(own[0], arm) for own in by_init.values() for arm in sorted(own[1:])]
    return pairs + [(oldest[0], arm) for arm in sorted(oldest[1:])]


def _unlike(arm: Arm, other: Arm, settings: Mapping[Arm, Mapping[str, Any]]) -> int:
    """The number of swept settings that both arms have with different values."""
    one, two = (
        {key: str(value) for key, value in settings.get(own, {}).items()} | dict(own.variant)
        for own in (arm, other)
    )
    swept = dict([*arm.variant, *other.variant])
    return sum(key in one and key in two and one[key] != two[key] for key in swept)


def uncompared(arms: Sequence[Arm], pairs: Sequence[tuple[Arm, Arm]], baseline: str) -> list[Note]:
    """A note with the reason for each of ``arms`` that is in none of ``pairs``."""
    compared = set(itertools.chain(*pairs))
    notes = []
    for arm in arms:
        if arm in compared or len(arms) == 1:
            continue
        if arm.densify != baseline:
            partner = replace(arm, densify=baseline, variant=())
            notes.append(Note.of("no partner", arm=arm, partner=partner))
        elif any(other.init == arm.init and other.densify != baseline for other in arms):
            notes.append(Note.of("far baseline", arm=arm))
        else:
            notes.append(Note.of("lone baseline", arm=arm))
    return notes


def controls_of(trials: Sequence[Configured]) -> dict[str, str]:
    """The control of each densifier: another densifier that the trials' ``eval.controls`` name."""
    arms = group_by(trials, lambda trial: (trial.init, trial.densify))
    firsts = [group[0] for group in arms.values()]
    return {
        key.removeprefix(CONTROLS): str(value)
        for trial in firsts
        for key, value in trial.config.items()
        if key.startswith(CONTROLS)
    }
