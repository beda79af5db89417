"""The trend of a difference along a setting, such as the size of pictures: does a small verdict hold for larger ones?

Each pair of trials (scene and seed) has a difference at every value of the setting. Whatever is asked of them is one
weighted sum of these differences for each pair: its change by doubling is the slope of the least-squares line through
them over log2 of the value, its bend that of the parabola, the change from a small value to the largest their
difference. So each is tested over pairs of trials as every other difference is (`statistics.student`), and pairs whose
lines disagree make it unsure, however well each line fits its own points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.cells import TRIAL_FIELDS, by_key, check_fields
from gsbench.analysis.pairing import pair_trials
from gsbench.analysis.quantities import Quantity
from gsbench.analysis.results import TrialResult
from gsbench.analysis.statistics import Interval, StudentT, adjust, student
from gsbench.errors import InputError
from gsbench.runs.splits import setting
from gsbench.words import counted

LEAST_VALUES = 3  # that a line has to be fitted to: through two every line goes

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Answer:
    """A mean over scenes with its test; ``p`` and ``interval`` are adjusted (Holm) for the family that it is one of.

    Both are None of a single pair of trials.
    """

    mean: float
    interval: Interval | None
    p: float | None


@dataclass(frozen=True)
class Step:
    """The difference at one value of the setting.

    ``to_largest`` is how much the difference changes from here to the largest value (None at that one), ``same_sign``
    in how many of the scenes it has the sign there that it has here.
    """

    value: float
    difference: Answer
    by_scene: Mapping[str, float]
    to_largest: Answer | None
    same_sign: int


@dataclass(frozen=True)
class Trend:
    """Second arm minus first over the values of a setting; ``pairs`` is how many pairs of scene and seed it is of.

    ``doubling`` is the change of the difference when the value doubles, ``bend`` how much that change itself changes
    from one doubling to the next (twice the parabola's leading coefficient). Both are tests of their own, while the
    differences at the values are one family, and so are the changes to the largest.
    """

    steps: tuple[Step, ...]
    doubling: Answer
    bend: Answer
    line: tuple[float, ...]  # the fitted line at each value
    pairs: int
    left_out: tuple[str, ...]


def trend(
    trials: Sequence[TrialResult], first: str, second: str, along: str, quantity: Quantity, init: str | None = None
) -> Trend:
    """Return how the densifier ``second`` minus ``first`` goes with the setting ``along``, whose values are above 0.

    ``along`` is a dotted key, or a field of trials such as ``iterations``. Pairs are trials of one scene, seed and
    initialiser (``init``: of this one alone); only those that have every value count. Raises InputError where fewer
    than three values or no such pair are there, where values are no numbers above 0, or where trials of one value
    differ in more than their seed.
    """
    check_fields(trials, [along])
    if first == second:
        raise InputError(f"{first} would be held against itself: name another arm")
    own = [trial for trial in trials if trial.densify in (first, second) and init in (None, trial.init)]
    values = _values(own, along)
    found = {value: _differences(group, first, second, quantity) for value, group in values.items()}
    everywhere = set.intersection(*(set(pairs) for pairs in found.values()))
    left_out = tuple(
        f"{along}={value:g}: {scene}, seed {seed}, since other values lack it"
        for value, pairs in found.items()
        for scene, seed in sorted(pairs.keys() - everywhere)
    )
    if not everywhere:
        raise InputError(f"no scene and seed has {quantity.key} of {first} and {second} at all values of {along}")
    scenes = list(dict.fromkeys(scene for scene, _ in sorted(everywhere)))
    matrices = [
        np.array([[found[value][pair] for value in found] for pair in sorted(everywhere) if pair[0] == scene])
        for scene in scenes
    ]  # each [K, V]: pairs of the scene by values
    return _fit(np.array(list(found)), scenes, matrices, left_out)


def _values(trials: Sequence[TrialResult], along: str) -> dict[float, list[TrialResult]]:
    """The trials by their value of the setting, the smallest first."""
    groups: dict[float, list[TrialResult]] = {}
    for trial in trials:
        value = getattr(trial.record, along) if along in TRIAL_FIELDS else setting(trial.config, along)
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise InputError(f"{trial.label}: {along} is {value!r}, and a trend goes over numbers above 0")
        groups.setdefault(float(value), []).append(trial)
    if len(groups) < LEAST_VALUES:
        there = ", ".join(f"{value:g}" for value in sorted(groups)) or "none"
        raise InputError(f"{along} has {counted(len(groups), 'value')} here ({there}), and a line needs {LEAST_VALUES}")
    return dict(sorted(groups.items()))


def _differences(
    trials: Sequence[TrialResult], first: str, second: str, quantity: Quantity
) -> dict[tuple[str, int], float]:
    """The difference of each pair of trials of one value, by scene and seed."""
    found: dict[tuple[str, int], float] = {}
    for init, own in by_key(trials, lambda trial: trial.init).items():
        for one, other in pair_trials(own, (init, first), (init, second)):
            before, after = quantity.read(one), quantity.read(other)
            if before is None or after is None:
                continue
            if (one.scene, one.seed) in found:
                raise InputError(f"{one.scene} has trials of several initialisers: choose one by --init")
            found[one.scene, one.seed] = after - before
    return found


def _fit(values: Array, scenes: Sequence[str], matrices: Sequence[Array], left_out: tuple[str, ...]) -> Trend:
    doublings = np.log2(values)  # [V]
    line = np.linalg.pinv(np.stack([np.ones_like(doublings), doublings], axis=1))  # [2, V]: level and slope as sums
    parabola = np.linalg.pinv(np.stack([doublings**power for power in range(3)], axis=1))  # [3, V]
    last = len(values) - 1
    here = np.eye(len(values))  # [V, V]
    at = _family([_test(matrices, weights) for weights in here])
    to_largest = _family([_test(matrices, here[last] - weights) for weights in here[:last]])
    means = np.array([matrix.mean(axis=0) for matrix in matrices])  # [S, V]
    level, slope = line @ means.mean(axis=0)
    steps = tuple(
        Step(
            float(value),
            at[place],
            dict(zip(scenes, means[:, place].tolist(), strict=True)),
            to_largest[place] if place < last else None,
            int((np.sign(means[:, place]) == np.sign(means[:, last])).sum()),
        )
        for place, value in enumerate(values)
    )
    (doubling,), (bend,) = (_family([_test(matrices, weights)]) for weights in (line[1], 2 * parabola[2]))
    fitted = tuple((level + slope * doublings).tolist())
    return Trend(steps, doubling, bend, fitted, sum(map(len, matrices)), left_out)


def _test(matrices: Sequence[Array], weights: Array) -> tuple[float, StudentT | None]:
    """(mean over scenes, test) of the sum of each pair's differences [V] times ``weights`` [V]."""
    per_trial = [matrix @ weights for matrix in matrices]  # [K] each
    return float(np.mean([values.mean() for values in per_trial])), student(per_trial)


def _family(tests: Sequence[tuple[float, StudentT | None]]) -> list[Answer]:
    """Answers of tests that are one family."""
    answers = adjust([test for _, test in tests])
    return [Answer(mean, one.interval, one.p_family) for (mean, _), one in zip(tests, answers, strict=True)]
