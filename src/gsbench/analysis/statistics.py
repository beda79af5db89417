"""Tests of paired differences: of these scenes, and of scenes like these.

Differences are matrices [S, K]: of S scenes, each with K pairs of trainings. The views of a trial share its training,
so a trial is the smallest unit that counts.

*These scenes*: the mean over the scenes at hand, each with the same weight; scenes are fixed, the units are pairs
within them, and each scene has a variance of its own (Welch 1947; Satterthwaite 1946). *Scenes like these*, from
``MIN_SCENES`` on: in how many of them it helps, by the sign test, with the exact interval of the median effect. It
assumes nothing about the shape of the effects; no test of their mean could stand one scene that differs much from seven
others.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gsbench.runs.declaration import ERROR_RATE

ALPHA = ERROR_RATE
MIN_SCENES = 6  # of which a statement about scenes like these is made
SUPPORTED, REFUTED, TOO_SMALL, UNDECIDED = "supported", "refuted", "too small to matter", "undecided"
Outcome = Literal["supported", "refuted", "too small to matter", "undecided"]

# Satterthwaite's degrees of freedom are twice too many where one scene is noisier than the others and seeds are two to
# four, as simulations show (docs/verdict.md): its own deviation comes out too small as often as too large.
DEGREES = 0.5
SPENDING_POWER = 1.5
DRAWS = 100_000
FIRST_LOOK = 2  # seeds: one training of each arm says nothing of how trainings differ
EACH_UP_TO = 12  # seeds up to which every seed is a look; beyond, a look costs little patience and a bound's precision

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Interval:
    low: float
    high: float

    def excludes_zero(self) -> bool:
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class StudentT:
    """Student's t of a mean with a standard error, on so many degrees of freedom: its p and its interval."""

    mean: float
    error: float
    degrees: float

    @property
    def p(self) -> float:
        """Two-sided; of units that do not spread at all 0, or 1 where their mean is 0."""
        if self.error == 0:
            return 1.0 if self.mean == 0 else 0.0
        return float(2 * special.stdtr(self.degrees, -abs(self.mean / self.error)))

    def interval(self, alpha: float = ALPHA) -> Interval:
        """The values that the test with error rate ``alpha`` would not refuse; zero is none exactly where p < alpha."""
        half = float(special.stdtrit(self.degrees, 1 - alpha / 2)) * self.error
        return Interval(self.mean - half, self.mean + half)


def student(differences: Array) -> StudentT | None:
    """The test of the mean over scenes of ``differences`` [S, K]; None of a single pair.

    With one pair a scene, the spread of the scenes stands for that of trainings: it is never too small in the mean.
    """
    scenes, seeds = differences.shape
    if differences.size < 2:
        return None
    if seeds == 1:
        return StudentT(float(differences.mean()), float(differences.std(ddof=1)) / math.sqrt(scenes), scenes - 1)
    variances = (differences - differences[:, :1]).var(axis=1, ddof=1)  # of pairs that are equal exactly 0
    error, degrees = error_and_degrees(variances[None], seeds)
    return StudentT(float(differences.mean()), float(error[0]), float(degrees[0]))


def error_and_degrees(variances: Array, seeds: int) -> tuple[Array, Array]:
    """Standard error and degrees of freedom [D] of the mean over scenes, from the scenes' variances [D, S]."""
    total, squares = variances.sum(axis=1), (variances**2).sum(axis=1)
    satterthwaite = np.divide(total**2 * (seeds - 1), squares, out=np.full_like(total, seeds - 1.0), where=squares > 0)
    return np.sqrt(total / seeds) / variances.shape[1], np.maximum(seeds - 1, DEGREES * satterthwaite)


def outcome_of(interval: Interval, sign: int, least: float | None) -> Outcome:
    """The one of four outcomes that an interval of the difference makes of "it has this sign, and matters".

    Supported where the interval lies wholly on the claimed side of zero, refuted on the other; too small to matter
    where it lies within ± ``least``, whichever its sign. Of "there is no difference to speak of" (sign 0): supported
    within ± ``least``, refuted beyond it.
    """
    within = least is not None and max(-interval.low, interval.high) < least
    if not sign:
        beyond = least is not None and max(interval.low, -interval.high) > least
        return "supported" if within else "refuted" if beyond else "undecided"
    if within:
        return "too small to matter"
    if not interval.excludes_zero():
        return "undecided"
    return "supported" if sign * interval.low > 0 or sign * interval.high > 0 else "refuted"


@dataclass(frozen=True)
class Answer:
    """A mean difference with its test as one of a family whose error rate is ``level``.

    ``p`` is adjusted for the family, and so is ``interval``, at the error rate ``rate``: it leaves zero out exactly
    where ``p`` is below ``level``. What is too small is told at ``equal_rate``, a member's equal part of ``level``. Of
    a single pair there is no test.
    """

    mean: float
    test: StudentT | None
    level: float
    rate: float
    equal_rate: float
    p: float | None = None

    @property
    def interval(self) -> Interval | None:
        return None if self.test is None or not self.rate else self.test.interval(self.rate)

    def outcome(self, sign: int, least: float | None) -> Outcome:
        if self.test is None or self.interval is None:
            return "undecided"
        found = outcome_of(self.test.interval(self.equal_rate), sign, least)
        return found if found == TOO_SMALL or not sign else outcome_of(self.interval, sign, None)


def answer_family(members: Sequence[Array], level: float = ALPHA) -> list[Answer]:
    """Test each of ``members`` [S, K] as one of a family, by Holm's method (1979).

    The chance that any sign which is told is false is at most ``level``, and so it is for what is called too small.
    """
    tests = [student(member) for member in members]
    factors = holm_factors([None if test is None else test.p for test in tests])
    equal = level / max(1, sum(test is not None for test in tests))
    return [
        Answer(float(member.mean()), None, level, level, level)
        if test is None or factor is None
        else Answer(test.mean, test, level, level / factor, equal, min(1.0, factor * test.p))
        for member, test, factor in zip(members, tests, factors, strict=True)
    ]


def holm_factors(p_values: Iterable[float | None]) -> list[float | None]:
    """The factor by which Holm's method multiplies each p, at least 1; None for None, which is not counted.

    The smallest of m by m, the next by m - 1, and so on, but none below the one before it.
    """
    p_values = list(p_values)
    order = sorted((p, index) for index, p in enumerate(p_values) if p is not None)
    factors: list[float | None] = [None] * len(p_values)
    running = 0.0
    for rank, (p, index) in enumerate(order):
        running = max(running, (len(order) - rank) * p)
        factors[index] = running / p if p > 0 else float(len(order) - rank)
    return factors


@dataclass(frozen=True)
class LikeThese:
    """A statement of scenes about scenes like them: in how many the arm has the sign that is asked for.

    ``beyond`` of them have it by the least that matters, None where that is not known. ``share`` is the exact interval
    (Clopper and Pearson 1934) of the share of such scenes with the sign, ``median`` that of their median effect, from
    the order of the scenes; None with too few scenes for ``level``. ``p`` is that of the sign test.
    """

    scenes: int
    helped: int
    beyond: int | None
    share: Interval
    median: Interval | None
    p: float
    level: float
    outcome: Outcome

    @property
    def needed(self) -> int | None:
        """The number of scenes that must agree before it can be said; None where all of them would not suffice."""
        return sign_test_needs(self.scenes, self.level)

    def power(self, share: float = 0.9) -> float:
        """The chance to say it where it helps in this share of scenes like these."""
        if self.needed is None:
            return 0.0
        return float(special.bdtrc(self.needed - 1, self.scenes, share))


def like_these(means: Array, sign: int, least: float | None, level: float = ALPHA) -> LikeThese | None:
    """The statement about scenes like these from the scenes' ``means`` [S]; None below `MIN_SCENES`."""
    count = len(means)
    if count < MIN_SCENES:
        return None
    toward = means * (sign or 1)
    helped, hurt = int((toward > 0).sum()), int((toward < 0).sum())
    median = median_interval(means, level)
    return LikeThese(
        count,
        helped,
        None if least is None else int((toward >= least).sum()),
        _share_interval(helped, count, level),
        median,
        _sign_p(max(helped, hurt), count),
        level,
        "undecided" if median is None else outcome_of(median, sign, least),
    )


def median_interval(values: Array, level: float) -> Interval | None:
    """The exact interval of the median that ``values`` [n] are drawn with, from order statistics; None of too few."""
    count = len(values)
    outer = [k for k in range(count // 2) if 2 * float(special.bdtr(k, count, 0.5)) <= level]
    if not outer:
        return None
    ordered = np.sort(values)
    return Interval(float(ordered[outer[-1]]), float(ordered[count - 1 - outer[-1]]))


def sign_test_needs(scenes: int, level: float) -> int | None:
    """The number of ``scenes`` with one sign from which on the sign test is below ``level``; None where none is."""
    return next((agree for agree in range(scenes // 2 + 1, scenes + 1) if _sign_p(agree, scenes) <= level), None)


def _sign_p(agree: int, count: int) -> float:
    """Two-sided p of the sign test where ``agree`` of ``count`` have one sign."""
    return min(1.0, 2 * float(special.bdtrc(agree - 1, count, 0.5))) if agree else 1.0


def _share_interval(found: int, count: int, level: float) -> Interval:
    low = float(special.betaincinv(found, count - found + 1, level / 2)) if found else 0.0
    high = float(special.betaincinv(found + 1, count - found, 1 - level / 2)) if found < count else 1.0
    return Interval(low, high)


def plan_looks(maximum: int) -> tuple[int, ...]:
    """The looks of at most ``maximum`` seeds: each seed from the second on, later every fourth."""
    early = range(FIRST_LOOK, min(maximum, EACH_UP_TO) + 1)
    return tuple(dict.fromkeys([*early, *range(EACH_UP_TO, maximum, 4), maximum]))


@cache
def look_levels(scenes: int, looks: tuple[int, ...], alpha: float) -> tuple[float, ...]:
    """The error rate of the interval at each look, such that all intervals together err in ``alpha``.

    Repeated confidence intervals (Jennison and Turnbull 1989): whichever look one stops at, and why, the chance of a
    false word is at most ``alpha``. How much of it is used up by a look with the share t of all seeds is fixed
    beforehand, ``alpha t^1.5`` (Lan and DeMets 1983; Kim and DeMets 1987). That the looks share trials is made use of:
    the rates come from `DRAWS` sequences of trainings in which scenes are equally noisy, and no look has more than has
    been used up by then, which holds however noisy scenes are.
    """
    rng = np.random.default_rng(0)
    totals, squares = np.zeros((DRAWS, scenes)), np.zeros((DRAWS, scenes))
    inside = np.ones(DRAWS, dtype=bool)
    found: list[float] = []
    before = 0
    for seeds in looks:
        new = seeds - before
        added = rng.normal(0, math.sqrt(new), totals.shape)
        totals += added
        squares += added**2 / new + (rng.chisquare(new - 1, totals.shape) if new > 1 else 0.0)
        error, degrees = error_and_degrees((squares - totals**2 / seeds) / (seeds - 1), seeds)
        p = 2 * special.stdtr(degrees, -np.abs(totals.mean(axis=1) / seeds / error))
        spent = alpha * (seeds / looks[-1]) ** SPENDING_POWER
        more = round(spent * DRAWS) - int(np.count_nonzero(~inside))
        level = min(spent, float(np.partition(p[inside], more)[more])) if more > 0 else 0.0
        inside &= p >= level
        found.append(level)
        before = seeds
    return tuple(found)
