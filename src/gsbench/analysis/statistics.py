"""Comparison of two arms: paired differences by scene, seed and view, with tests that respect what is repeated.

The views of one trial share its training, so they are no independent repetitions of it: a trial is the smallest unit
that a test here counts. Three questions are kept apart. *This scene*: do the differences of its trials, paired by seed,
differ from zero? *These scenes*: the same for the mean over the scenes at hand. *Scenes like these*: is the mean over
scenes different from zero when scenes are the units (asked from ``MIN_SCENES`` on, since fewer cannot answer)?
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gsbench.analysis.pairing import Paired

ALPHA = 0.05
MIN_SCENES = 6  # scenes of which a statement about scenes like these is made
MAX_ENUMERATED = 16  # units whose 2^n sign patterns are all tried
RANDOM_FLIPS = 100_000
BOOTSTRAP_SAMPLES = 4000
POWER = 0.8
MAX_SEEDS = 1000
LARGEST_SHIFT = 30.0  # in standard errors; beyond it scipy's noncentral t gives nan, and all is seen

TOO_FEW = " (too few for an exact test)"
NOT_REPEATED = "none, since no trial was repeated with another seed"
SCENES_LIKE_THESE, THESE_SCENES, THIS_SCENE = "scenes like these", "these scenes", "this scene"

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Interval:
    low: float
    high: float

    def excludes_zero(self) -> bool:
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class SceneComparison:
    """One scene: the mean of its trials' differences, Student's interval over them, and p before and after Holm.

    ``better_views`` is the share of views (averaged over trials) in which the second arm is better.
    """

    scene: str
    mean: float
    deviation: float | None  # of the trials' differences
    trials: int
    views: int
    interval: Interval | None
    p: float | None
    p_holm: float | None
    better_views: float


@dataclass(frozen=True)
class Comparison:
    """Second arm minus first in one metric, averaged over scenes.

    ``p`` is of this comparison alone, ``p_family`` adjusted for the ``family`` of comparisons that it was one of, by
    Holm. ``scope`` is what the verdict speaks of ("scenes like these", "these scenes" or "this scene"), ``test`` what
    gave ``p``. ``effect_size`` is the mean difference in deviations of the units tested (Cohen's d for pairs), None
    with fewer than two. ``interval`` is the bootstrap interval. ``verdict`` is better, worse or "no evidence".
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
    seed_deviation: float | None
    left_out: tuple[str, ...]
    p_family: float | None
    family: int = 1


def compare(
    paired: Paired, direction: int, samples: int = BOOTSTRAP_SAMPLES, seed: int = 0, family: int = 1
) -> Comparison:
    """Compare two arms; ``direction`` is +1 where more of the metric is better, -1 where less is.

    The verdict is better or worse only where the test's p is below 5 % and the bootstrap interval excludes zero. The
    test is chosen for one of ``family`` comparisons; `compare_family` adjusts for their number.
    """
    per_trial = [matrix.mean(axis=1) for matrix in paired.differences]  # [K] for each scene
    per_scene = np.array([values.mean() for values in per_trial])  # [S]
    mean = float(per_scene.mean())
    p, test, scope, units = _overall_test(per_trial, per_scene, family)
    interval = bootstrap_interval(paired.differences, scope == SCENES_LIKE_THESE, samples, np.random.default_rng(seed))
    return Comparison(
        metric=paired.metric,
        mean=mean,
        relative=mean / paired.baseline_mean if paired.baseline_mean else math.nan,
        interval=interval,
        p=p,
        test=test,
        scope=scope,
        effect_size=_standardised(units),
        verdict=_verdict(p, interval, mean * direction),
        scenes=_scene_comparisons(paired, per_trial, direction),
        seed_deviation=pooled_deviation(per_trial),
        left_out=paired.left_out,
        p_family=p,
    )


def compare_family(
    members: Sequence[tuple[Paired, int]], samples: int = BOOTSTRAP_SAMPLES, seed: int = 0
) -> list[Comparison]:
    """Compare each of ``members`` (pairs of arms in one metric, direction) as one of a family of questions.

    The chance that any verdict of the family is false is held at 5 %, by Holm's method.
    """
    size = len(members)
    found = [compare(paired, direction, samples, seed, size) for paired, direction in members]
    return [
        replace(one, p_family=p, family=size, verdict=_verdict(p, one.interval, one.mean * direction))
        for one, p, (_, direction) in zip(found, holm([one.p for one in found]), members, strict=True)
    ]


def _verdict(p: float | None, interval: Interval | None, gain: float) -> str:
    decided = p is not None and p < ALPHA and interval is not None and interval.excludes_zero()
    return "no evidence" if not decided else "better" if gain > 0 else "worse"


def units_needed(family: int = 1) -> int:
    """The fewest units with which the exact test can reach 5 % as one of ``family`` tests that Holm adjusts.

    Over n units it cannot give p below 2^(1 - n).
    """
    return 1 + math.ceil(math.log2(family / ALPHA))


def _overall_test(per_trial: Sequence[Array], per_scene: Array, family: int) -> tuple[float | None, str, str, Array]:
    """(p, test, scope, units tested): over scenes where there are enough, else over trials.

    Where the units are too few for the exact test to reach 5 %, Student's t is taken; that hangs on numbers of trials,
    scenes and comparisons alone, never on a result.
    """
    needed = units_needed(family)
    if len(per_scene) >= MIN_SCENES:
        count = len(per_scene)
        if count >= needed:
            return (
                sign_flip_p(per_scene, np.ones(count)),
                f"exact sign flips of {count} scenes",
                SCENES_LIKE_THESE,
                per_scene,
            )
        return stratified_t_p([per_scene]), f"Student's t over {count} scenes{TOO_FEW}", SCENES_LIKE_THESE, per_scene
    scope = THESE_SCENES if len(per_scene) > 1 else THIS_SCENE
    pairs = np.concatenate(list(per_trial))  # [sum of K]
    weights = np.concatenate([np.full(len(values), 1 / len(values)) for values in per_trial])
    if len(pairs) >= needed:
        return sign_flip_p(pairs, weights), f"exact sign flips of {len(pairs)} pairs of trials", scope, pairs
    p = stratified_t_p(per_trial)
    test = f"Student's t over {len(pairs)} pairs of trials{TOO_FEW}"
    return p, test if p is not None else NOT_REPEATED, scope, pairs


def sign_flip_p(values: Array, weights: Array) -> float:
    """Two-sided p of the weighted sum of ``values`` [n] when every sign is equally likely.

    Exact over all 2^n patterns up to ``MAX_ENUMERATED`` units, else from random patterns with a fixed seed.
    """
    terms = values * weights  # [n]
    observed = abs(terms.sum())
    if len(terms) <= MAX_ENUMERATED:
        half = _sign_patterns(
            len(terms) - 1
        )  # a pattern and its negative give the same absolute sum: fix the first sign
        sums = terms[0] + half @ terms[1:]  # [2^(n-1)]
        return float(np.mean(np.abs(sums) >= observed * (1 - 1e-12)))
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(RANDOM_FLIPS, len(terms)))
    extreme = np.count_nonzero(np.abs(signs @ terms) >= observed * (1 - 1e-12))
    return (extreme + 1) / (RANDOM_FLIPS + 1)


def _sign_patterns(n: int) -> Array:
    """All 2^n rows of signs, [2^n, n]."""
    bits = (np.arange(2**n)[:, None] >> np.arange(n)) & 1
    return 1.0 - 2.0 * bits


def stratified_t_p(per_trial: Sequence[Array]) -> float | None:
    """Two-sided p of the mean of scenes, with the trials' variance pooled within scenes; None without a repetition."""
    deviation = pooled_deviation(per_trial)
    if deviation is None:
        return None
    mean = float(np.mean([values.mean() for values in per_trial]))
    error = deviation * math.sqrt(sum(1 / len(values) for values in per_trial)) / len(per_trial)
    if error == 0:
        return 1.0 if mean == 0 else 0.0
    degrees = sum(len(values) - 1 for values in per_trial)
    return float(2 * special.stdtr(degrees, -abs(mean / error)))


def pooled_deviation(per_trial: Sequence[Array]) -> float | None:
    """Deviation of paired differences between trials of one scene, pooled over scenes; None without a repetition."""
    degrees = sum(len(values) - 1 for values in per_trial)
    if degrees == 0:
        return None
    return math.sqrt(sum(float(((values - values.mean()) ** 2).sum()) for values in per_trial) / degrees)


def bootstrap_interval(
    differences: Sequence[Array], resample_scenes: bool, samples: int, rng: np.random.Generator
) -> Interval | None:
    """95 % percentile interval of the mean of scenes of ``differences`` ([K, V] each); None where nothing is repeated.

    With ``resample_scenes``, scenes are drawn anew and keep their trials and views, since the spread of the scenes'
    means already contains that of what is below (Davison and Hinkley 1997, section 3.8). Otherwise the trials and the
    views of each scene are drawn anew, a view together for all trials, since every trial sees the same ones; the
    deviations of the two are added. Percentile intervals from n units are too short: deviations are stretched by
    ``sqrt(n / (n - 1)) t / z`` (Hesterberg 2015, "What teachers should know about the bootstrap").
    """
    scenes = len(differences)
    center = float(np.mean([matrix.mean() for matrix in differences]))
    if resample_scenes:
        means = np.array([matrix.mean() for matrix in differences])  # [S]
        deviations = _stretch(scenes, scenes - 1) * (_resampled_means(means, samples, rng) - center)
    elif min(len(matrix) for matrix in differences) > 1:
        deviations = np.zeros(samples)
        for axis in (0, 1):
            degrees = sum(matrix.shape[axis] - 1 for matrix in differences)
            for matrix in differences:
                if matrix.shape[axis] > 1:  # a single view cannot be drawn anew
                    drawn = _resampled_means(matrix.mean(axis=1 - axis), samples, rng) - matrix.mean()
                    deviations += _stretch(matrix.shape[axis], degrees) * drawn / scenes
    else:
        return None
    low, high = np.quantile(deviations, [ALPHA / 2, 1 - ALPHA / 2])
    return Interval(center + float(low), center + float(high))


def _resampled_means(values: Array, samples: int, rng: np.random.Generator) -> Array:
    """Means [samples] of as many values drawn with replacement from ``values`` [n]."""
    n = len(values)
    drawn: Array = rng.multinomial(n, np.full(n, 1 / n), size=samples) @ values / n
    return drawn


def _stretch(units: int, degrees: int) -> float:
    """How much wider Student's interval of ``units`` values is than the percentile interval of their bootstrap."""
    normal = special.ndtri(1 - ALPHA / 2)
    return float(math.sqrt(units / (units - 1)) * special.stdtrit(degrees, 1 - ALPHA / 2) / normal)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """Holm's step-down adjustment, which holds the chance of any false finding; None stays None and is not counted."""
    order = sorted((p, index) for index, p in enumerate(p_values) if p is not None)
    adjusted: list[float | None] = [None] * len(p_values)
    running = 0.0
    for rank, (p, index) in enumerate(order):
        running = max(running, min(1.0, (len(order) - rank) * p))
        adjusted[index] = running
    return adjusted


def seeds_needed(deviation: float, scenes: int, difference: float, power: float = POWER) -> int | None:
    """Seeds per arm and scene for a two-sided 5 % t test to see ``difference`` of the mean over ``scenes``.

    ``deviation`` is that of paired differences between seeds. None above ``MAX_SEEDS``. The noncentral t distribution
    gives the power; more seeds do not tell more about other scenes.
    """
    for seeds in range(2, MAX_SEEDS + 1):
        if t_power(difference, deviation / math.sqrt(scenes * seeds), scenes * (seeds - 1)) >= power:
            return seeds
    return None


def t_power(difference: float, error: float, degrees: int, alpha: float = ALPHA) -> float:
    """The chance that a two-sided t test sees ``difference``, with this standard error and these degrees of freedom.

    By the noncentral t distribution; the far tail of the wrong sign is left out.
    """
    if error == 0:
        return 1.0 if difference else 0.0
    shift = min(difference / error, LARGEST_SHIFT)
    return float(1 - special.nctdtr(degrees, shift, special.stdtrit(degrees, 1 - alpha / 2)))


def _scene_comparisons(paired: Paired, per_trial: Sequence[Array], direction: int) -> tuple[SceneComparison, ...]:
    p_values = [_scene_p(values) for values in per_trial]
    rows = zip(paired.scenes, per_trial, paired.differences, p_values, holm(p_values), strict=True)
    return tuple(
        SceneComparison(
            scene=scene,
            mean=float(values.mean()),
            deviation=float(values.std(ddof=1)) if len(values) > 1 else None,
            trials=len(values),
            views=matrix.shape[1],
            interval=t_interval(values),
            p=p,
            p_holm=adjusted,
            better_views=float(np.mean(direction * matrix.mean(axis=0) > 0)),
        )
        for scene, values, matrix, p, adjusted in rows
    )


def _scene_p(values: Array) -> float | None:
    return sign_flip_p(values, np.ones(len(values))) if len(values) >= units_needed() else stratified_t_p([values])


def t_interval(values: Array) -> Interval | None:
    """Student's 95 % interval of the mean of ``values`` [n]; None of a single one."""
    if len(values) < 2:
        return None
    half = float(special.stdtrit(len(values) - 1, 1 - ALPHA / 2) * values.std(ddof=1) / math.sqrt(len(values)))
    return Interval(float(values.mean()) - half, float(values.mean()) + half)


def _standardised(units: Array) -> float | None:
    if len(units) < 2 or units.std(ddof=1) == 0:
        return None
    return float(units.mean() / units.std(ddof=1))
