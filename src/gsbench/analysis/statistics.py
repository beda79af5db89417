"""Comparison of two arms: paired differences by scene and seed, with one test that respects what is repeated.

The views of one trial share its training, so they are no independent repetitions of it: a trial is the smallest unit
that a test here counts. Three questions are kept apart. *This scene*: do the differences of its trials, paired by seed,
differ from zero? *These scenes*: the same for the mean over the scenes at hand. *Scenes like these*: is the mean over
scenes different from zero when scenes are the units (asked from ``MIN_SCENES`` on, and beside the question before it,
never in its place)?

Each is answered by Student's t, whatever the numbers of scenes, trials and questions: with few trials nothing else can
answer, and a change of method by their number would let a verdict become surer with less data. p and interval are two
readings of one test: an interval leaves zero out exactly where its p is below 5 %.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gsbench.analysis.pairing import Paired

ALPHA = 0.05
MIN_SCENES = 6  # scenes of which a statement about scenes like these is made

NOT_REPEATED = "none, since no trial was repeated with another seed or scene"
THESE_SCENES, THIS_SCENE = "these scenes", "this scene"

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
    degrees: int

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


@dataclass(frozen=True)
class SceneComparison:
    """One scene: the mean of its trials' differences, with p and interval of Student's t over them.

    ``p`` is of this test alone; ``p_family`` and ``interval`` are adjusted (Holm) for the family of all scenes in all
    comparisons that were made together. ``better_views`` is the share of views (averaged over trials) in which the
    second arm is better.
    """

    scene: str
    mean: float
    deviation: float | None  # of the trials' differences
    trials: int
    views: int
    interval: Interval | None
    p: float | None
    p_family: float | None
    better_views: float


@dataclass(frozen=True)
class BeyondScenes:
    """Test of whether the finding holds for scenes like these: the same mean, with scenes as units.

    ``p`` is the larger one of that test and of the one about these scenes, since the narrower statement must hold
    first; ``p_family`` is adjusted for the family, and ``holds`` where it is below 5 %.
    """

    scenes: int
    p: float
    p_family: float

    @property
    def holds(self) -> bool:
        return self.p_family < ALPHA


@dataclass(frozen=True)
class Comparison:
    """Second arm minus first in one metric, averaged over scenes.

    ``p`` is of this comparison alone. ``p_family`` is adjusted by Holm for the ``family`` of comparisons that it was
    one of, and ``interval`` is as wide as that asks: it leaves zero out exactly where ``p_family`` is below 5 %. Of a
    single comparison it is the usual 95 % interval. ``scope`` is what the verdict speaks of ("these scenes" or "this
    scene"), ``test`` what gave ``p``; ``beyond`` says whether it holds for scenes like these, None with too few.
    ``effect_size`` is the mean difference in deviations of the pairs of trials (Cohen's d for pairs), ``deviation``
    their deviation; None with fewer than two. ``verdict`` is better, worse or "no evidence".
    """

    metric: str
    mean: float
    relative: float
    interval: Interval | None
    p: float | None
    test: str
    scope: str
    effect_size: float | None
    verdict: str
    scenes: tuple[SceneComparison, ...]
    deviation: float | None
    left_out: tuple[str, ...]
    p_family: float | None
    beyond: BeyondScenes | None = None
    family: int = 1


def compare(paired: Paired, direction: int) -> Comparison:
    """Compare two arms; ``direction`` is +1 where more of the metric is better, -1 where less is.

    The verdict is better or worse where the test's p is below 5 %, and so where the interval leaves zero out.
    """
    return compare_family([(paired, direction)])[0]


def compare_family(members: Sequence[tuple[Paired, int]]) -> list[Comparison]:
    """Compare each of ``members`` (pairs of arms in one metric, direction) as one of a family of questions.

    The chance that any verdict of the family is false is held at 5 %, by Holm's method. What is said of single scenes
    is a family of its own, and so is what is said of scenes like these.
    """
    per_trial = [[matrix.mean(axis=1) for matrix in paired.differences] for paired, _ in members]  # [K] for each scene
    tests = [student(values) for values in per_trial]
    adjusted = adjust(tests)
    by_scene = [[student([values]) for values in one] for one in per_trial]
    several = iter(adjust([test for tests in by_scene if len(tests) > 1 for test in tests]))
    of_scenes = [
        [next(several) for _ in tests] if len(tests) > 1 else [whole]  # one scene is the whole: one answer
        for tests, whole in zip(by_scene, adjusted, strict=True)
    ]
    beyond = _beyond_scenes(per_trial, tests)
    return [
        _comparison(paired, direction, values, answer, scenes, wider, len(members))
        for (paired, direction), values, answer, scenes, wider in zip(
            members, per_trial, adjusted, of_scenes, beyond, strict=True
        )
    ]


@dataclass(frozen=True)
class Adjusted:
    """A test as one of a family; None where there is nothing to test."""

    p: float | None
    p_family: float | None
    interval: Interval | None


def adjust(tests: Sequence[StudentT | None]) -> list[Adjusted]:
    """The tests as one family: each p times Holm's factor, each interval at the level divided by the same."""
    p_values = [None if test is None else test.p for test in tests]
    return [
        Adjusted(None, None, None)
        if test is None or factor is None
        else Adjusted(test.p, min(1.0, factor * test.p), test.interval(ALPHA / factor))
        for test, factor in zip(tests, holm_factors(p_values), strict=True)
    ]


def _comparison(
    paired: Paired,
    direction: int,
    per_trial: Sequence[Array],
    answer: Adjusted,
    scenes: Sequence[Adjusted],
    beyond: BeyondScenes | None,
    family: int,
) -> Comparison:
    mean = float(np.mean([values.mean() for values in per_trial]))
    pairs = np.concatenate(list(per_trial))  # [n]
    decided = answer.p_family is not None and answer.p_family < ALPHA
    return Comparison(
        metric=paired.metric,
        mean=mean,
        relative=mean / paired.baseline_mean if paired.baseline_mean else math.nan,
        interval=answer.interval,
        p=answer.p,
        test=NOT_REPEATED if answer.p is None else f"Student's t over {len(pairs)} pairs of trials",
        scope=THESE_SCENES if len(per_trial) > 1 else THIS_SCENE,
        effect_size=_standardised(pairs),
        verdict="no evidence" if not decided else "better" if mean * direction > 0 else "worse",
        scenes=_scene_comparisons(paired, per_trial, scenes, direction),
        deviation=float(pairs.std(ddof=1)) if len(pairs) > 1 else None,
        left_out=paired.left_out,
        p_family=answer.p_family,
        beyond=beyond,
        family=family,
    )


def student(per_trial: Sequence[Array]) -> StudentT | None:
    """The test of the mean of scenes' means, whose units are the pairs of trials ([K] for each scene); None of one.

    Their plain deviation, between scenes and within, makes the standard error, as in `claims.sequential`: scenes that
    disagree make a verdict rarer, and not false.
    """
    pairs = np.concatenate(list(per_trial))  # [n]
    if len(pairs) < 2:
        return None
    weights = np.concatenate([np.full(len(values), 1 / len(values)) for values in per_trial]) / len(per_trial)  # [n]
    error = float(pairs.std(ddof=1)) * math.sqrt(float((weights**2).sum()))
    return StudentT(float(weights @ pairs), error, len(pairs) - 1)


def _beyond_scenes(per_trial: Sequence[Sequence[Array]], tests: Sequence[StudentT | None]) -> list[BeyondScenes | None]:
    """For each member with scenes enough: whether it holds for scenes like these.

    The two statements are tested in a fixed order (Maurer, Hothorn and Lehmacher 1995): about these scenes first. So
    each keeps its own 5 %, and leaving out a scene never makes a verdict of what is none with it by their number alone.
    """
    p_values: list[float | None] = []
    for scenes, test in zip(per_trial, tests, strict=True):
        over = student([np.array([values.mean() for values in scenes])]) if len(scenes) >= MIN_SCENES else None
        p_values.append(None if over is None or test is None else max(over.p, test.p))
    return [
        None if p is None or p_family is None else BeyondScenes(len(scenes), p, p_family)
        for p, p_family, scenes in zip(p_values, holm(p_values), per_trial, strict=True)
    ]


def pooled_deviation(per_trial: Sequence[Array]) -> float | None:
    """Deviation of paired differences between trials of one scene, pooled over scenes; None without a repetition."""
    degrees = sum(len(values) - 1 for values in per_trial)
    if degrees == 0:
        return None
    return math.sqrt(sum(float(((values - values.mean()) ** 2).sum()) for values in per_trial) / degrees)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Holm's step-down adjustment, which holds the chance of any false finding; None stays None and is not counted."""
    return [
        None if p is None or factor is None else min(1.0, factor * p)
        for p, factor in zip(p_values, holm_factors(p_values), strict=True)
    ]


def holm_factors(p_values: Iterable[float | None]) -> list[float | None]:
    """The factor by which Holm's method (1979) multiplies each p, at least 1; None for None, which is not counted.

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


def t_interval(values: Array) -> Interval | None:
    """Student's 95 % interval of the mean of ``values`` [n]; None of a single one."""
    test = student([values])
    return None if test is None else test.interval()


def _scene_comparisons(
    paired: Paired, per_trial: Sequence[Array], answers: Sequence[Adjusted], direction: int
) -> tuple[SceneComparison, ...]:
    rows = zip(paired.scenes, per_trial, paired.differences, answers, strict=True)
    return tuple(
        SceneComparison(
            scene=scene,
            mean=float(values.mean()),
            deviation=float(values.std(ddof=1)) if len(values) > 1 else None,
            trials=len(values),
            views=matrix.shape[1],
            interval=answer.interval,
            p=answer.p,
            p_family=answer.p_family,
            better_views=float(np.mean(direction * matrix.mean(axis=0) > 0)),
        )
        for scene, values, matrix, answer in rows
    )


def _standardised(units: Array) -> float | None:
    if len(units) < 2 or units.std(ddof=1) == 0:
        return None
    return float(units.mean() / units.std(ddof=1))
