"""Tests of paired differences.

Tests are about these scenes, or about scenes like these. Differences are matrices [S, K] of S
scenes, each with K pairs of trainings. The views of a trial share its training, so a trial is the
smallest independent unit.

*These scenes*: the mean over the given scenes, each with the same weight. Scenes are fixed, pairs
within them are the units, and each scene has its own variance (`Region`).
*Scenes like these*, from ``MIN_SCENES`` scenes on: the sign test of the number of scenes whose
measured mean gains. It is exact for `exact_for` and for nothing else: the measured means have the
noise of trainings, so the median effect without noise can have the other sign. It assumes nothing
about the distribution of effects; tests of the mean effect fail if one scene in eight differs much
from the others.

Thresholds are the standard errors that a mean over scenes needs to be significant at a level.
With one scene it is Student's threshold with K - 1 degrees of freedom, for K seeds. With several
scenes it is lower, the more evenly they share the variance: ``student ** (1 - f) * normal ** f``,
where ``normal`` is the threshold of the normal distribution. The part f in 0..1 depends on the
numbers of scenes and seeds, on the level, and on how ``even`` the shares are: log(1 / largest
share) / log(scenes), 0 if one scene has all variance and 1 if all have the same.
`scripts/regions.py` chose f for the greatest power among all f that keep the level for every ratio
of noise (findings/simulations.md, "Thresholds"); it is tabulated in ``thresholds.npz``.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import scipy  # loads scipy.special at its first use: 0.4 s
from numpy.typing import NDArray

from gsbench.runs.commands import ERROR_RATE

ALPHA = ERROR_RATE
# for a statement about scenes like these: the fewest with which the sign test can reach 5 %
MIN_SCENES = 6
Outcome = Literal["supported", "refuted", "too small to matter", "undecided"]

Array = NDArray[np.floating]

TABLE = Path(__file__).with_name("thresholds.npz")
# Below this level the tabulated thresholds are too low for some ratios of noise (their size at .5 %
# is .58 %), so Student's threshold, which is larger, decides.
LEAST_LEVEL = 0.005
LEAST_P, MOST_P = 1e-12, 0.99  # the p between which thresholds are computed
STEPS = 45  # of the bisection for p, which halve its relative error each


@cache
def table() -> Mapping[str, Array]:
    """f [S, K, L, Y] at numbers of ``scenes`` and ``seeds``, ``levels`` (falling) and ``knots``.

    Knots are evennesses.
    """
    with np.load(TABLE) as file:
        return {name: file[name].astype(np.float64) for name in file.files}


@dataclass(frozen=True, eq=False)
class Region:
    """The thresholds of D means over ``scenes``, each with ``seeds`` pairs.

    ``even`` [D] says how evenly the scenes share the variance (`evenness`).
    """

    scenes: int
    seeds: int
    even: Array

    def limits(self, level: Array | float) -> Array:
        """The thresholds [D] at a level, or at one for each mean.

        f is interpolated linearly; beyond the table its last value holds.
        """
        known = table()
        axes = (
            (np.log(self.scenes), np.log(known["scenes"])),
            (self.seeds, known["seeds"]),
            (-np.log(level), -np.log(known["levels"])),
            (self.even, known["knots"]),
        )
        places = [np.interp(value, axis, np.arange(len(axis))) for value, axis in axes]
        f = scipy.ndimage.map_coordinates(known["f"], np.broadcast_arrays(*places), order=1)
        f = np.where(np.less(level, LEAST_LEVEL) | (self.scenes == 1), 0.0, f)
        return self._student(level) * np.exp(f * self._ratio(level))

    def p_values(self, sizes: Array) -> Array:
        """The two-sided p [D] of means with these ``sizes`` [D] in standard errors."""
        low, high = np.full(sizes.shape, np.log(LEAST_P)), np.zeros(sizes.shape)
        for _ in range(STEPS):
            middle = (low + high) / 2
            significant = sizes > self.limits(np.exp(middle))
            low, high = np.where(significant, low, middle), np.where(significant, middle, high)
        return np.exp(high)

    def _student(self, level: Array | float) -> Array:
        return -scipy.special.stdtrit(self.seeds - 1, np.asarray(level) / 2)

    def _ratio(self, level: Array | float) -> Array:
        """log(normal / Student's threshold); below the lowest level of the table, that of it."""
        own = np.clip(level, table()["levels"][-1], MOST_P)
        return np.log(-scipy.special.ndtri(own / 2) / self._student(own))


def evenness(variances: Array) -> Array:
    """The evenness, 0 to 1, with which scenes share their estimated ``variances`` [..., S]."""
    scenes = variances.shape[-1]
    total, largest = variances.sum(axis=-1), variances.max(axis=-1)
    if scenes == 1:
        return np.zeros_like(total)
    shares = np.divide(total, largest, out=np.ones_like(total), where=largest > 0)
    return np.log(shares) / np.log(scenes)


@dataclass(frozen=True)
class Interval:
    low: float
    high: float

    def excludes_zero(self) -> bool:
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class StudentT:
    """Student's t test of a mean with a standard error and degrees of freedom.

    A mean over several scenes has the thresholds of its ``region`` instead.
    """

    mean: float
    error: float
    degrees: float
    region: Region | None = None

    @property
    def p(self) -> float:
        """The two-sided p. Without any spread it is 0, or 1 if the mean is 0."""
        if self.error == 0:
            return 1.0 if self.mean == 0 else 0.0
        size = abs(self.mean / self.error)
        if self.region is not None:
            return float(self.region.p_values(np.array([size]))[0])
        return float(2 * scipy.special.stdtr(self.degrees, -size))

    def interval(self, alpha: float = ALPHA) -> Interval:
        """The values that the test with error rate ``alpha`` does not reject.

        The interval excludes 0 exactly if p < alpha.
        """
        if self.region is not None:
            threshold = float(self.region.limits(alpha)[0])
        else:
            threshold = float(scipy.special.stdtrit(self.degrees, 1 - alpha / 2))
        half = threshold * self.error
        return Interval(self.mean - half, self.mean + half)


def t_test(differences: Array) -> StudentT | None:
    """The test of the mean over scenes of ``differences`` [S, K]; None for a single pair.

    With one pair per scene, the variance over scenes replaces that of trainings; on average it is
    never too small.
    """
    scenes, seeds = differences.shape
    if differences.size < 2:
        return None
    if seeds == 1:
        return StudentT(
            float(differences.mean()),
            float(differences.std(ddof=1)) / math.sqrt(scenes),
            scenes - 1,
        )
    # Without the shift, rounding would give equal pairs a tiny variance in place of 0.
    variances = (differences - differences[:, :1]).var(axis=1, ddof=1)
    own = None if scenes == 1 else Region(scenes, seeds, evenness(variances[None]))
    error = float(np.sqrt(variances.sum() / seeds)) / scenes
    return StudentT(float(differences.mean()), error, seeds - 1, own)


def outcome_of(interval: Interval, sign: int, least: float | None) -> Outcome:
    """The outcome of the claim "the difference has this sign, and matters", from its interval.

    Too small to matter: the interval lies within ± ``least``. Supported: it lies on the claimed
    side of 0. Refuted: it lies on the other side. Otherwise undecided. Sign 0 claims that no
    difference matters: supported within ± ``least``, refuted if the interval lies beyond it on
    one side.
    """
    within = least is not None and max(-interval.low, interval.high) < least
    if not sign:
        beyond = least is not None and max(interval.low, -interval.high) > least
        return "supported" if within else "refuted" if beyond else "undecided"
    if within:
        return "too small to matter"
    if not interval.excludes_zero():
        return "undecided"
    return "supported" if sign * interval.low > 0.0 else "refuted"


def favoured(outcome: Outcome, sign: int, direction: int) -> tuple[int, ...]:
    """The sides that an outcome favours: 0 for the baseline, 1 for the arm.

    ``sign`` is that of the claim, ``direction`` says whether more is better. If neither side is
    better by the outcome, or if that is not known, both are favoured.
    """
    if outcome == "undecided":
        return ()
    toward = sign * direction * (1 if outcome == "supported" else -1)
    return (0, 1) if outcome == "too small to matter" or not toward else (int(toward > 0),)


@dataclass(frozen=True)
class LikeThese:
    """A statement about scenes like the given ``scenes``.

    In ``helped`` of them the difference has the asked sign. In ``beyond`` of them it is at
    least the least that matters; None if that is not known.
    """

    scenes: int
    helped: int
    beyond: int | None
    level: float
    outcome: Outcome

    @property
    def needed(self) -> int | None:
        """The number of scenes that must agree in sign to decide; None if all would not suffice."""
        return sign_test_needs(self.scenes, self.level)


def exact_for(seeds: int) -> str:
    """The meaning of "better" about scenes like these, in words; "worse" says the opposite."""
    mean = "one training" if seeds == 1 else f"the mean of {seeds} trainings"
    return f"on a new scene like these, {mean} of the arm would more often be better"


def judge_like_these(
    means: Array, sign: int, least: float | None, level: float = ALPHA
) -> LikeThese | None:
    """The statement about scenes like these, from the scenes' mean differences [S].

    None below `MIN_SCENES` scenes.
    """
    count = len(means)
    if count < MIN_SCENES:
        return None
    toward = means * (sign or 1)
    median = median_interval(means, level)
    return LikeThese(
        count,
        int((toward > 0).sum()),
        None if least is None else int((toward >= least).sum()),
        level,
        "undecided" if median is None else outcome_of(median, sign, least),
    )


def median_interval(values: Array, level: float) -> Interval | None:
    """The exact interval of the median of which ``values`` [n] are a sample; None for too few."""
    count = len(values)
    outer = [k for k in range(count // 2) if 2 * float(scipy.special.bdtr(k, count, 0.5)) <= level]
    if not outer:
        return None
    ordered = np.sort(values)
    return Interval(float(ordered[outer[-1]]), float(ordered[count - 1 - outer[-1]]))


def sign_test_needs(scenes: int, level: float) -> int | None:
    """The fewest of ``scenes`` with one sign for which the sign test has p ≤ ``level``, or None."""
    return next(
        (
            agree
            for agree in range(scenes // 2 + 1, scenes + 1)
            if 2 * float(scipy.special.bdtrc(agree - 1, scenes, 0.5)) <= level
        ),
        None,
    )
