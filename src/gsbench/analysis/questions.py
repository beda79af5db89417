"""Interpolation and extrapolation: what an arm gains at each, where an order of arms turns, and how far they lie apart.

Views that are held out one by one among training views ask a model to interpolate; a contiguous part of the cameras
asks it to extrapolate. Trials of both are paired by arm, scene and seed; their views are not the same ones.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gsbench.analysis.cells import swept_settings
from gsbench.analysis.quantities import Quantity, choose_quantities
from gsbench.analysis.results import Arm, TrialResult
from gsbench.analysis.statistics import Interval, t_interval
from gsbench.analysis.verdicts import ArmVerdict, ArmVerdicts, Pair
from gsbench.runs.declaration import EXTRAPOLATION, INTERPOLATION

# settings that say what is held out: trials that differ in them alone are of one arm
SPLIT_SETTINGS = tuple(
    f"scene.{name}"
    for name in ("split", "sector", "sectors", "match_views", "validation", "test_every", "train_list", "test_list")
)
TURNS, HOLDS, UNSURE, OPEN = "turns", "holds", "signs differ, undecided", "undecided"


@dataclass(frozen=True)
class Turn:
    """One pair of arms in one metric under both questions; ``change`` is the gain at extrapolation minus the other.

    ``word`` is `TURNS` where the verdict is better at one and worse at the other, `HOLDS` where both say the same,
    `UNSURE` where the signs differ and a verdict lacks, `OPEN` elsewhere. ``interval`` is Student's 95 % over pairs of
    seeds.
    """

    first: Arm
    second: Arm
    split: str  # of the extrapolation, such as "sector 0 of 8"
    interpolation: ArmVerdict
    extrapolation: ArmVerdict
    change: float | None
    interval: Interval | None
    word: str

    @property
    def quantity(self) -> Quantity:
        return self.interpolation.quantity


@dataclass(frozen=True)
class Gap:
    """One arm in one metric: extrapolation minus interpolation, the mean over scenes with Student's interval over
    seeds."""

    arm: Arm
    split: str
    quantity: Quantity
    interpolation: float
    extrapolation: float
    mean: float
    interval: Interval | None


def without_split(trials: Sequence[TrialResult]) -> dict[str, Arm]:
    """The arm of each trial, by its path, whatever was held out."""
    swept = [key for key in swept_settings(trials) if key not in SPLIT_SETTINGS]
    arms = {}
    for trial in trials:
        variant = tuple((key, str(trial.config.get(key))) for key in swept)
        arms[str(trial.path)] = Arm(trial.init, trial.densify, variant)
    return arms


def find_turns(trials: Sequence[TrialResult], judged: Mapping[Pair, ArmVerdicts]) -> list[Turn]:
    """Every pair of arms that was compared at interpolation and at extrapolation, in each metric of both."""
    bases = without_split(trials)
    by_arm: dict[Arm, list[TrialResult]] = {}
    for trial in trials:
        by_arm.setdefault(trial.arm, []).append(trial)
    asked: dict[str, list[tuple[Pair, Pair, ArmVerdicts]]] = {INTERPOLATION: [], EXTRAPOLATION: []}
    for pair, verdicts in judged.items():
        own = [by_arm[arm][0] for arm in pair if arm in by_arm]
        if len(own) == 2 and own[0].split == own[1].split and own[0].question in asked:
            base = (bases[str(own[0].path)], bases[str(own[1].path)])
            asked[own[0].question].append((base, pair, verdicts))
    turns = []
    for base, near, near_verdicts in asked[INTERPOLATION]:
        for other, far, far_verdicts in asked[EXTRAPOLATION]:
            if base != other:
                continue
            found = {verdict.quantity.key: verdict for verdict in far_verdicts.verdicts}
            for verdict in near_verdicts.verdicts:
                if verdict.quantity.key in found:
                    turns.append(_turn(base, verdict, found[verdict.quantity.key], near, far, by_arm))
    return turns


def find_gaps(trials: Sequence[TrialResult]) -> list[Gap]:
    """The fall of each arm with trials of both questions, from interpolation to extrapolation."""
    bases = without_split(trials)
    groups: dict[Arm, dict[str, list[TrialResult]]] = {}
    for trial in trials:
        if trial.question:
            groups.setdefault(bases[str(trial.path)], {}).setdefault(trial.split, []).append(trial)
    gaps = []
    for arm, splits in groups.items():
        near = [own for own in splits.values() if own[0].question == INTERPOLATION]
        far = {split: own for split, own in splits.items() if own[0].question == EXTRAPOLATION}
        for interpolating in near:
            for split, extrapolating in far.items():
                for quantity in choose_quantities([*interpolating, *extrapolating]):
                    gap = _gap(arm, split, quantity, interpolating, extrapolating)
                    if gap is not None and not quantity.cost:
                        gaps.append(gap)
    return gaps


def _turn(
    base: Pair,
    near: ArmVerdict,
    far: ArmVerdict,
    near_arms: Pair,
    far_arms: Pair,
    by_arm: Mapping[Arm, list[TrialResult]],
) -> Turn:
    gains = [by_seed_differences(by_arm[pair[0]], by_arm[pair[1]], near.quantity) for pair in (near_arms, far_arms)]
    change, interval = difference_over_seeds(*gains)
    decided = all(one.verdict.interval is not None and one.verdict.interval.excludes_zero() for one in (near, far))
    same = (near.verdict.mean or 0.0) * (far.verdict.mean or 0.0) > 0
    word = (HOLDS if same else TURNS) if decided else (OPEN if same else UNSURE)
    return Turn(*base, by_arm[far_arms[0]][0].split, near, far, change, interval, word)


def _gap(
    arm: Arm, split: str, quantity: Quantity, near: Sequence[TrialResult], far: Sequence[TrialResult]
) -> Gap | None:
    first, second = _values(near, quantity), _values(far, quantity)
    mean, interval = difference_over_seeds(first, second)
    shared = first.keys() & second.keys()
    if mean is None:
        return None
    one, other = (statistics.fmean(values[key] for key in shared) for values in (first, second))
    return Gap(arm, split, quantity, one, other, mean, interval)


Values = Mapping[tuple[str, int], float]  # by scene and seed


def by_seed_differences(first: Sequence[TrialResult], second: Sequence[TrialResult], quantity: Quantity) -> Values:
    """Second minus first by scene and seed, of those that both have."""
    one, other = _values(first, quantity), _values(second, quantity)
    return {key: other[key] - one[key] for key in sorted(one.keys() & other.keys())}


def difference_over_seeds(first: Values, second: Values) -> tuple[float | None, Interval | None]:
    """The mean over scenes and seeds of second minus first, and Student's interval over the seeds' means of scenes."""
    by_seed: dict[int, list[float]] = {}
    for scene, seed in sorted(first.keys() & second.keys()):
        by_seed.setdefault(seed, []).append(second[scene, seed] - first[scene, seed])
    if not by_seed:
        return None, None
    most = max(len(values) for values in by_seed.values())
    means = np.array([statistics.fmean(values) for values in by_seed.values() if len(values) == most])
    return float(means.mean()), t_interval(means)


def _values(trials: Sequence[TrialResult], quantity: Quantity) -> dict[tuple[str, int], float]:
    found = {(trial.scene, trial.seed): quantity.read(trial) for trial in trials}
    return {key: value for key, value in found.items() if value is not None}
