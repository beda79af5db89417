"""Tests of paired differences, and planning from pilot trials.

Tests are about these scenes, or about scenes like these. Differences are matrices [S, K] of S
scenes, each with K pairs of trainings. The views of a trial share its training, so a trial is the
smallest independent unit.

*These scenes*: the mean over the given scenes, each with the same weight. Scenes are fixed, pairs
within them are the units, and each scene has its own variance (`gsbench.analysis.thresholds`).
*Scenes like these*, from ``MIN_SCENES`` scenes on: the sign test of the number of scenes whose
measured mean gains. It is exact for `exact_for` and for nothing else: the measured means have the
noise of trainings, so the median effect without noise can have the other sign. It assumes nothing
about the distribution of effects; tests of the mean effect fail if one scene in eight differs much
from the others.

Planning: the paired difference of scene s and seed k is ``mean + scene effect + noise``. The scene
effect has one deviation between scenes, the noise another one between trainings of a scene. Both
are estimated from pilot trials by the analysis of variance (Searle, Casella and McCulloch 1992,
*Variance components*, section 3.6). More seeds shrink only the noise; a statement about scenes like
these needs more scenes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gsbench.analysis.thresholds import Region, evenness
from gsbench.errors import InputError
from gsbench.runs.experiments import ERROR_RATE

ALPHA = ERROR_RATE
# for a statement about scenes like these: the fewest with which the sign test can reach 5 %
MIN_SCENES = 6
SUPPORTED, REFUTED, TOO_SMALL, UNDECIDED = (
    "supported",
    "refuted",
    "too small to matter",
    "undecided",
)
Outcome = Literal["supported", "refuted", "too small to matter", "undecided"]

SPENDING_POWER = 1.5  # exponent of the error-spending function of looks
DRAWS = 100_000  # simulated sequences of trainings, for the error rates of looks
NOISY = (1.0, 4.0, 15.0)  # in these sequences, one scene is so many times as noisy as the others
DRIFT = 3.0  # deviation of a drift in a part of them, so that rare errors are seen more often
FIRST_LOOK = 2  # seeds: one training of each arm does not show how trainings differ
# seeds up to which each seed is a look; more looks would save little and make bounds less precise
EACH_UP_TO = 12

POWER = 0.8  # of planned designs: that of the two-sided tests with the error rate ``ALPHA``
MAX_SCENES, MAX_SEEDS = 30, 40  # the largest designs that are considered
DESIGN_DRAWS = 2000  # simulated variances of a design; they give its power to about 0.005

Array = NDArray[np.floating]


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
        return float(2 * special.stdtr(self.degrees, -size))

    def interval(self, alpha: float = ALPHA) -> Interval:
        """The values that the test with error rate ``alpha`` does not reject.

        The interval excludes 0 exactly if p < alpha.
        """
        if self.region is not None:
            threshold = float(self.region.limits(alpha)[0])
        else:
            threshold = float(special.stdtrit(self.degrees, 1 - alpha / 2))
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
    if outcome == UNDECIDED:
        return ()
    toward = sign * direction * (1 if outcome == SUPPORTED else -1)
    return (0, 1) if outcome == TOO_SMALL or not toward else (int(toward > 0),)


@dataclass(frozen=True)
class Answer:
    """A mean difference with its test, as a member of a family with the error rate ``level``.

    ``p`` is adjusted for the family. ``interval`` has the adjusted error rate ``rate``: it excludes
    0 exactly if ``p`` is below ``level``. "Too small to matter" is decided at ``equal_rate``, the
    member's equal share of ``level``. A single pair has no test.
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
        at_equal_rate = outcome_of(self.test.interval(self.equal_rate), sign, least)
        return (
            at_equal_rate
            if at_equal_rate == TOO_SMALL or not sign
            else outcome_of(self.interval, sign, None)
        )


def answer_family(members: Sequence[Array], level: float = ALPHA) -> list[Answer]:
    """Test each of ``members`` [S, K] as a member of one family, by Holm's method (1979).

    The chance that any stated sign is false is at most ``level``; so is the chance that any "too
    small" is false.
    """
    tests = [t_test(member) for member in members]
    factors = iter(holm_factors([test.p for test in tests if test is not None]))
    equal_rate = level / max(1, sum(test is not None for test in tests))
    answers = []
    for member, test in zip(members, tests, strict=True):
        if test is None:
            answers.append(Answer(float(member.mean()), None, level, level, level))
        else:
            factor = next(factors)
            answers.append(
                Answer(
                    test.mean, test, level, level / factor, equal_rate, min(1.0, factor * test.p)
                )
            )
    return answers


def holm_factors(p_values: Sequence[float]) -> list[float]:
    """The factor (at least 1) by which Holm's method multiplies each p.

    The smallest of m p is multiplied by m, the next by m - 1, and so on. A product below the one
    before it is raised to that one.
    """
    factors = [0.0] * len(p_values)
    running = 0.0
    ascending = sorted((p, index) for index, p in enumerate(p_values))
    for left, (p, index) in zip(range(len(p_values), 0, -1), ascending, strict=True):
        running = max(running, left * p)
        factors[index] = running / p if p > 0 else float(left)
    return factors


@dataclass(frozen=True)
class LikeThese:
    """A statement about scenes like the given ``scenes``.

    In ``helped`` of them the difference has the asked sign. In ``beyond`` of them it is at
    least the least that matters; None if that is not known. ``share`` is the exact interval
    (Clopper and Pearson 1934) of the share of such scenes with the sign. ``median`` is the
    interval of the median of such means, from order statistics; None with too few scenes for
    ``level``. ``p`` is that of the sign test.
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
        """The number of scenes that must agree in sign to decide; None if all would not suffice."""
        return sign_test_needs(self.scenes, self.level)

    def power(self, share: float = 0.9) -> float:
        """The chance to decide if this share of scenes like these gains."""
        if self.needed is None:
            return 0.0
        return float(special.bdtrc(self.needed - 1, self.scenes, share))


def exact_for(seeds: int) -> str:
    """The meaning of "better" about scenes like these, in words; "worse" says the opposite."""
    mean = "one training" if seeds == 1 else f"the mean of {seeds} trainings"
    return f"on a new scene like these, {mean} of the arm would more often be better"


EXACT_FOR_PEOPLE = "a new person, asked the same pairs, would more often prefer it"


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
    """The exact interval of the median of which ``values`` [n] are a sample; None for too few."""
    count = len(values)
    outer = [k for k in range(count // 2) if 2 * float(special.bdtr(k, count, 0.5)) <= level]
    if not outer:
        return None
    ordered = np.sort(values)
    return Interval(float(ordered[outer[-1]]), float(ordered[count - 1 - outer[-1]]))


def sign_test_needs(scenes: int, level: float) -> int | None:
    """The fewest of ``scenes`` with one sign for which the sign test has p ≤ ``level``, or None."""
    return next(
        (agree for agree in range(scenes // 2 + 1, scenes + 1) if _sign_p(agree, scenes) <= level),
        None,
    )


def _sign_p(agree: int, count: int) -> float:
    """The two-sided p of the sign test if ``agree`` of ``count`` have the same sign."""
    return min(1.0, 2 * float(special.bdtrc(agree - 1, count, 0.5))) if agree else 1.0


def _share_interval(helped: int, count: int, level: float) -> Interval:
    low = float(special.betaincinv(helped, count - helped + 1, level / 2)) if helped else 0.0
    high = (
        float(special.betaincinv(helped + 1, count - helped, 1 - level / 2))
        if helped < count
        else 1.0
    )
    return Interval(low, high)


def plan_looks(maximum: int) -> tuple[int, ...]:
    """The numbers of seeds at which there is a look, up to ``maximum``.

    There is one at each number from `FIRST_LOOK` to `EACH_UP_TO`, then at every fourth, and at
    ``maximum``.
    """
    early = range(FIRST_LOOK, min(maximum, EACH_UP_TO) + 1)
    return tuple(dict.fromkeys([*early, *range(EACH_UP_TO, maximum, 4), maximum]))


@cache
def look_levels(
    scenes: int, looks: tuple[int, ...], alpha: float, draws: int = DRAWS
) -> tuple[float, ...]:
    """The error rate of the interval at each look; all looks together have the rate ``alpha``.

    These are repeated confidence intervals (Jennison and Turnbull 1989): at whichever look one
    stops, and for whatever reason, the chance of a false statement is at most ``alpha``. Looks
    up to the share t of all seeds may spend ``alpha t^1.5`` of it (Lan and DeMets 1983; Kim and
    DeMets 1987). Looks share trials, so their errors overlap: the rates come from ``draws``
    simulated sequences of trainings.
    """
    # Equally noisy scenes alone would not do: the test is cautious there, so each look would get
    # all that may be spent.
    simulated = [_simulate_looks(1, looks, draws)]
    if scenes > 1:
        simulated += [_simulate_looks(scenes, looks, draws, noise) for noise in NOISY]
    # The test itself keeps the level of the first look.
    levels = [alpha * (looks[0] / looks[-1]) ** SPENDING_POWER]
    error_free = [np.ones(draws, dtype=bool) for _ in simulated]
    spent = np.full(len(simulated), levels[0])
    for look, seeds in enumerate(looks[1:], 1):
        most = level = alpha * (seeds / looks[-1]) ** SPENDING_POWER
        new = []
        for one, free, used in zip(simulated, error_free, spent, strict=True):
            free &= one.sizes[look - 1] <= one.limits(look - 1, levels[-1])
            errors = np.flatnonzero(free & (one.sizes[look] > one.limits(look, most)))
            p = one.p_values(look, errors)
            order = np.argsort(p)
            p, weights = p[order], one.weights[errors][order]
            new.append((p, weights))
            over = np.searchsorted(weights.cumsum(), most - used, side="right")
            level = min(level, p[over] if over < len(p) else most)
        spent += [weights[p < level].sum() for p, weights in new]
        levels.append(float(level))
    return tuple(levels)


@dataclass(frozen=True, eq=False)
class _Sequences:
    """Simulated sequences of trainings without an effect, with ``weights`` [D] that sum to 1.

    ``sizes`` [L, D] are means in standard errors at each look; ``even`` [L, D] say how evenly the
    scenes share the variance.
    """

    scenes: int
    looks: tuple[int, ...]
    sizes: NDArray[np.float64]
    even: NDArray[np.float64]
    weights: NDArray[np.float64]

    def limits(self, look: int, level: float) -> NDArray[np.float64]:
        return Region(self.scenes, self.looks[look], self.even[look]).limits(level)

    def p_values(self, look: int, which: NDArray[np.int64]) -> NDArray[np.float64]:
        found = Region(self.scenes, self.looks[look], self.even[look, which])
        return found.p_values(self.sizes[look, which])


@cache
def _simulate_looks(
    scenes: int, looks: tuple[int, ...], draws: int, noise: float = 1.0
) -> _Sequences:
    """Sequences in which the first of ``scenes`` is ``noise`` times as noisy as the others.

    Two parts of the sequences have a drift, up to the first look or to the last, that makes errors
    more frequent. Weights undo it (importance sampling). The drift of a scene is proportional to
    its variance, so that the weights follow from the sum over scenes alone.
    """
    rng = np.random.default_rng(0)
    deviations = np.where(np.arange(scenes) == 0, noise, 1.0)
    of_sum = math.sqrt((deviations**2).sum())
    part = np.arange(draws) % 3  # no drift, until the first look, until the last
    drift = rng.normal(0, DRIFT, (draws, 1)) * deviations**2 / of_sum
    # of the differences of each scene
    totals, squares = np.zeros((draws, scenes)), np.zeros((draws, scenes))
    sizes, even, sums = (list[NDArray[np.float64]]() for _ in range(3))
    seeds_before = 0
    for seeds in looks:
        new = seeds - seeds_before
        drifts = (part == 2) / math.sqrt(looks[-1]) + (part == 1) * (not sizes) / math.sqrt(seeds)
        # The sum of the new seeds' differences, and the sum of their squares: drawing each seed
        # would be slower.
        added = deviations * rng.normal(0, math.sqrt(new), totals.shape)
        added += new * drifts[:, None] * drift
        within = rng.chisquare(new - 1, totals.shape) if new > 1 else 0.0
        totals += added
        squares += added**2 / new + deviations**2 * within
        variances = np.maximum(squares - totals**2 / seeds, 0) / (seeds - 1)
        sums.append(totals.sum(axis=1) / of_sum / math.sqrt(seeds))
        sizes.append(np.abs(totals.sum(axis=1)) / np.sqrt(seeds * variances.sum(axis=1)))
        even.append(evenness(variances))
        seeds_before = seeds
    spread = 1 + DRIFT**2
    drifted = [np.exp(one**2 / 2 * (1 - 1 / spread)) / math.sqrt(spread) for one in sums]
    weights = 3 / (1 + drifted[0] + drifted[-1]) / draws
    return _Sequences(scenes, looks, np.array(sizes), np.array(even), weights)


@dataclass(frozen=True)
class Components:
    """Deviations of paired differences, ``between`` scenes and ``within`` a scene.

    ``between`` is the deviation of the effect over scenes: None for a single scene, 0 if scenes
    differ by no more than trainings explain. ``within`` is the deviation over trainings of a
    scene.
    """

    between: float | None
    within: float
    scenes: int
    trials: int  # pairs


@dataclass(frozen=True)
class Design:
    """A design of two arms on ``scenes`` scenes, with ``seeds`` seeds each."""

    scenes: int
    seeds: int

    @property
    def trials(self) -> int:
        return 2 * self.scenes * self.seeds


def estimate_components(differences: Sequence[NDArray[np.float64]]) -> Components:
    """Estimate the two deviations from pilot trials' paired differences, an array per scene.

    Raises InputError if no scene has two pairs.
    """
    degrees = sum(len(values) - 1 for values in differences)
    if degrees == 0:
        raise InputError("planning needs pilot trials with at least two seeds of one scene")
    within = math.sqrt(
        sum(float(((values - values.mean()) ** 2).sum()) for values in differences) / degrees
    )
    counts = np.array([len(values) for values in differences], dtype=float)
    total = int(counts.sum())
    between = None
    if len(differences) > 1:
        means = np.array([values.mean() for values in differences])
        overall = float(np.concatenate(list(differences)).mean())
        # n_0 of unbalanced data
        pairs_per_scene = (total - float((counts**2).sum()) / total) / (len(counts) - 1)
        square = float((counts * (means - overall) ** 2).sum()) / (len(counts) - 1)
        between = math.sqrt(max(0.0, (square - within**2) / pairs_per_scene))
    return Components(between, within, len(differences), total)


def power(design: Design, difference: float, components: Components, like_these: bool) -> float:
    """The chance that a design shows ``difference`` by the test of its statement.

    The statement is about the mean of these scenes, or about scenes ``like_these`` (the sign
    test). Raises InputError for scenes like these if the pilot had only one scene.
    """
    if not like_these:
        return power_of_mean(components.within, design, difference)
    if components.between is None:
        raise InputError(
            "one scene cannot show how an effect differs between scenes: run pilot trials on two"
        )
    needed = sign_test_needs(design.scenes, ALPHA)
    if needed is None:
        return 0.0
    spread = math.hypot(components.between, components.within / math.sqrt(design.seeds))
    # that one scene's mean has the sign
    chance = float(special.ndtr(abs(difference) / spread)) if spread else 1.0
    return float(special.bdtrc(needed - 1, design.scenes, chance))


def power_of_mean(
    deviation: float, design: Design, difference: float, level: float = ALPHA
) -> float:
    """The chance that the t test of these scenes sees ``difference`` at ``level``.

    Trainings differ by ``deviation``. The test estimates each scene's variance and its own
    degrees of freedom. Given these, the power is that of a normal mean; the result is its
    average over simulated variances. The far tail of the wrong sign is left out.
    """
    if deviation == 0:
        return 1.0 if difference else 0.0
    shift = abs(difference) / deviation * math.sqrt(design.scenes * design.seeds)
    return float(special.ndtr(shift - _thresholds(design, level)).mean())


@cache
def _thresholds(design: Design, level: float) -> NDArray[np.float64]:
    """The smallest means [DESIGN_DRAWS] that are significant, in true standard errors.

    Each belongs to one draw of simulated variances of the scenes.
    """
    freedom = design.seeds - 1
    variances = np.random.default_rng(0).chisquare(freedom, (DESIGN_DRAWS, design.scenes)) / freedom
    error = np.sqrt(variances.mean(axis=1))
    return Region(design.scenes, design.seeds, evenness(variances)).limits(level) * error


def seeds_needed(deviation: float, scenes: int, difference: float) -> int | None:
    """The seeds of each arm that see ``difference`` on these ``scenes`` with a power of `POWER`.

    None above `MAX_SEEDS`.
    """
    designs = (Design(scenes, seeds) for seeds in range(2, MAX_SEEDS + 1))
    return next(
        (one.seeds for one in designs if power_of_mean(deviation, one, difference) >= POWER), None
    )


def designs_needed(difference: float, components: Components, like_these: bool) -> list[Design]:
    """The designs that see ``difference`` with a power of `POWER`, one per number of scenes.

    Each has the fewest seeds. A number of scenes is left out if it needs more than
    ``MAX_SEEDS`` seeds, or no fewer seeds than fewer scenes do. A statement about scenes like
    these starts at ``MIN_SCENES``. Raises InputError for a difference of 0 or one that is not
    finite.
    """
    if difference == 0 or not math.isfinite(difference):
        raise InputError(
            f"the difference to resolve must be a number other than 0, got {difference}"
        )
    chosen: list[Design] = []
    for scenes in range(MIN_SCENES if like_these else 1, MAX_SCENES + 1):
        most = chosen[-1].seeds - 1 if chosen else MAX_SEEDS
        for design in (Design(scenes, seeds) for seeds in range(2, most + 1)):
            if power(design, difference, components, like_these) >= POWER:
                chosen.append(design)
                break
    return chosen
