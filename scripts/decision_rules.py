"""Simulate rules for the test of the mean over scenes, for findings/simulations.md.

    python scripts/decision_rules.py                   print the table (about ten minutes)
    python scripts/decision_rules.py --draws 4000      print it from fewer draws

All draws go through a rule at once. Looks, spending of the rate and outlying trainings are those of
the judge (tests/analysis/test_decision_rules.py compares the decisions one by one). Differences are
in deviations of a pair of trainings; `LEAST` is the least effect that matters.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gsbench.analysis.judgement import FEW, OUTLYING
from gsbench.analysis.looks import SPENDING_POWER
from gsbench.analysis.looks import look_levels as levels_of_judge
from gsbench.analysis.thresholds import Region, evenness

Array = NDArray[np.float64]
Shape = Array | Region  # of a test's distribution: degrees of freedom [D], or thresholds
RATE, CLAIMS, LEAST, LOOKS = 0.05, 4, 1.0, (2, 3, 4)  # of a check
LONG = (2, 3, 4, 5, 6)  # looks of a sweep with one question
CALIBRATION, MANY = 20_000, 12  # draws for levels; seeds of a large baseline
NOISY = 10.0  # in a part of the draws for levels, one scene is so many times as noisy
UNDECIDED, SUPPORTED, REFUTED, TOO_SMALL = range(4)
ONE_ARM = "one arm fails"


@dataclass(frozen=True)
class Rule:
    """A rule: the variances that it uses, and the degrees of freedom that it counts for their sum.

    ``units`` is "pairs", "arms" (both of each scene), or "larger" (the larger of these two sums).
    The degrees are ``factor`` times Satterthwaite's, and at least those of one variance.
    """

    units: str
    name: str
    factor: Callable[[int], float]
    unbiased: bool = False  # s⁴ n / (n + 2) estimates σ⁴
    moderated: bool = False  # limma's
    alike: float = 0.0  # below this ratio of variances, all degrees count
    baseline: int = 0  # seeds, if more than the arm's
    equal_noise: bool = False  # levels of looks from equally noisy scenes alone
    tabulated: bool = False  # thresholds of the judge, in place of degrees

    def degrees(self, variances: Array, each: Array, seeds: int) -> tuple[Array, Shape]:
        """The variances to use [D, C], and the degrees of freedom [D] of their sum.

        The given variances [D, C] have ``each`` [C] degrees.
        """
        if self.tabulated:
            return variances, Region(variances.shape[1], seeds, evenness(variances))
        if self.moderated and len(each) > 1:
            return _moderate(variances, each)
        shift = 2 if self.unbiased else 0
        found = self.factor(seeds) * (_matched(variances, each + shift) - shift)
        similar = variances.max(axis=1) < self.alike * variances.min(axis=1)
        return variances, np.where(similar, each.sum(), np.maximum(each.min(), found))


def _matched(variances: Array, each: Array) -> Array:
    return np.asarray(variances.sum(axis=1) ** 2 / (variances**2 / each).sum(axis=1))


def _moderate(variances: Array, each: Array) -> tuple[Array, Array]:
    """As in limma: Smyth, Stat. Appl. Genet. Mol. Biol. 3 (2004) 3, section 6.2."""
    half = each[0] / 2
    logs = np.log(variances) - special.digamma(half) + math.log(half)
    excess = np.maximum(logs.var(axis=1, ddof=1) - special.polygamma(1, half), 1e-3)
    grid = np.geomspace(1e3, 1e-2, 2000)  # half of the prior's degrees of freedom
    prior = np.interp(excess, special.polygamma(1, grid), grid)
    common = np.exp(logs.mean(axis=1) + special.digamma(prior) - np.log(prior))
    drawn = (prior[:, None] * common[:, None] + half * variances) / (prior + half)[:, None]
    return drawn, np.minimum(_matched(drawn, 2 * (prior + half)[:, None]), each.sum())


def by_seeds(more: int) -> Callable[[int], float]:
    return lambda seeds: seeds / (seeds + more)


CHOSEN = Rule("pairs", "tabulated thresholds", lambda _: 0.0, tabulated=True)
RULES = [
    Rule("pairs", "1/2, levels from equal noise (before)", lambda _: 0.5, equal_noise=True),
    Rule("pairs", "1/2", lambda _: 0.5),
    CHOSEN,
    Rule("pairs", "K/(K+2)", by_seeds(2)),
    Rule("pairs", "K/(K+2), levels from equal noise", by_seeds(2), equal_noise=True),
    Rule("pairs", "1 − 1/K", lambda seeds: 1 - 1 / seeds),
    Rule("pairs", "1 (Satterthwaite)", lambda _: 1.0),
    Rule("pairs", "0: K − 1 degrees", lambda _: 0.0),
    Rule("pairs", "1, unbiased fourth moments", lambda _: 1.0, unbiased=True),
    Rule("pairs", "1/2, unbiased fourth moments", lambda _: 0.5, unbiased=True),
    Rule("pairs", "1/2, all if variances within 4 times", lambda _: 0.5, alike=4.0),
    Rule("pairs", "moderated variances (limma)", lambda _: 1.0, moderated=True),
    Rule("arms", "1/2", lambda _: 0.5),
    Rule("arms", "K/(K+3)", by_seeds(3)),
    Rule("arms", "K/(K+5)", by_seeds(5)),
    Rule("arms", "1 − 1/K", lambda seeds: 1 - 1 / seeds),
    Rule("arms", "1, unbiased fourth moments", lambda _: 1.0, unbiased=True),
    Rule("arms", "moderated variances (limma)", lambda _: 1.0, moderated=True),
    Rule("arms", "K/(K+3), 12 seeds of the baseline", by_seeds(3), baseline=MANY),
    Rule("larger", "K/(K+3)", by_seeds(3)),
    Rule("larger", "K/(K+4)", by_seeds(4)),
]


@dataclass(frozen=True, eq=False)
class Draws:
    """Trainings of ``baseline`` [D, S, MANY] and ``arm`` [D, S, K].

    ``effect`` is added to those of the arm; ``truth`` [D] is the real difference without it.
    """

    baseline: Array
    arm: Array
    effect: float = 0.0
    truth: Array | float = 0.0

    @lru_cache(maxsize=48)  # noqa: B019  the rules in turn ask for the same
    def variances(self, seeds: int, of_baseline: int) -> tuple[Array, Array, Array, Array]:
        """The means [D], and the variances [D, S] of means: of pairs, baselines and arms."""
        arm, baseline = self.arm[..., :seeds], self.baseline[..., :of_baseline]
        mean = (arm.mean(axis=2) - baseline.mean(axis=2)).mean(axis=1) + self.effect
        pairs = (arm - baseline[..., :seeds]).var(axis=2, ddof=1) / seeds
        own = [one.var(axis=2, ddof=1) / one.shape[2] for one in (baseline, arm)]
        return mean, pairs, own[0], own[1]

    def test(self, rule: Rule, seeds: int) -> tuple[Array, Array, Shape]:
        """Means, standard errors and degrees of freedom [D] of a rule with this many seeds."""
        of_baseline = rule.baseline or seeds
        mean, pairs, *own = self.variances(seeds, of_baseline)
        used, each = pairs, np.full(pairs.shape[1], seeds - 1.0)
        if rule.units != "pairs":
            used, each = np.hstack(own), np.append(np.full_like(each, of_baseline - 1), each)
        used, degrees = rule.degrees(used, each, seeds)
        least = pairs.sum(axis=1) if rule.units == "larger" else 0.0
        return mean, np.sqrt(np.maximum(used.sum(axis=1), least)) / pairs.shape[1], degrees


def p_values(mean: Array, error: Array, degrees: Shape) -> Array:
    if isinstance(degrees, Region):
        return degrees.p_values(np.abs(mean) / error)
    return np.asarray(2 * special.stdtr(degrees, -np.abs(mean) / error))


def significant(mean: Array, error: Array, degrees: Shape, level: float) -> NDArray[np.bool_]:
    """True where p is below the level [D]; for thresholds without computing p."""
    if isinstance(degrees, Region):
        return np.asarray(np.abs(mean) / error > degrees.limits(level))
    return p_values(mean, error, degrees) < level


@lru_cache(maxsize=1)
def calibration(scenes: int, seeds: int) -> list[Draws]:
    """Draws with equal noise, with a noisy scene, and with noise that is nearly all in one arm."""
    deviations = [np.ones((scenes, 2)) for _ in range(3)]
    deviations[1][0] = NOISY
    deviations[2][0, 1] = 1e3 * NOISY
    return [normal(np.random.default_rng(0), one, seeds, CALIBRATION) for one in deviations]


@cache
def look_levels(rule: Rule, scenes: int, looks: tuple[int, ...], rate: float) -> tuple[float, ...]:
    """The levels of the looks; for the judge's rule, its own."""
    if rule.tabulated:
        return levels_of_judge(scenes, looks, rate)
    simulated = calibration(scenes, looks[-1])[: 1 if rule.equal_noise else 3]
    free, levels = np.ones((len(simulated), CALIBRATION), dtype=bool), list[float]()
    for seeds in looks:
        p = np.array([p_values(*draws.test(rule, seeds)) for draws in simulated])
        highest = [rate * (seeds / looks[-1]) ** SPENDING_POWER]
        left = round(highest[0] * CALIBRATION) - np.count_nonzero(~free, axis=1)
        for own, ok, count in zip(p, free, left, strict=True):
            highest.append(float(np.partition(own[ok], count)[count]) if count > 0 else 0.0)
        levels.append(min(highest))
        free &= p >= levels[-1]
    return tuple(levels)


def decide(
    draws: Draws, rule: Rule, looks: Sequence[int], levels: Sequence[float]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The outcomes [D] at the first look that decides, and the seeds that they took [D]."""
    outcomes = np.full(len(draws.arm), UNDECIDED)
    taken = np.full(len(draws.arm), looks[-1])
    for seeds, level in zip(looks, levels, strict=True):
        mean, error, degrees = draws.test(rule, seeds)
        small = significant(np.maximum(LEAST - np.abs(mean), 0), error, degrees, level)
        known = significant(mean, error, degrees, level)
        signs = np.where(mean > 0, SUPPORTED, REFUTED)
        found = np.where(small, TOO_SMALL, np.where(known, signs, UNDECIDED))
        rest = _without_outlying(draws, seeds) if seeds > 2 else mean
        found[np.where(small, np.abs(rest) >= LEAST, rest * mean <= 0)] = UNDECIDED
        new = (outcomes == UNDECIDED) & (found != UNDECIDED)
        outcomes[new], taken[new] = found[new], seeds
    return outcomes, taken


def _without_outlying(draws: Draws, seeds: int) -> Array:
    """The mean difference [D] without the trainings that `judgement.find_outlying` names."""
    both = np.stack([draws.baseline[..., :seeds], draws.arm[..., :seeds]], axis=2)
    deviations = both.std(axis=3, ddof=1, keepdims=True)
    ordered = np.sort(deviations.reshape(len(both), -1), axis=1)
    typical = FEW * ordered[:, (ordered.shape[1] - 1) // 2]
    others = (both.sum(axis=3, keepdims=True) - both) / (seeds - 1)
    squares = (both**2).sum(axis=3, keepdims=True) - both**2 - (seeds - 1) * others**2
    spread = np.maximum(np.sqrt(np.maximum(squares, 0) / (seeds - 2)), deviations[:, :, ::-1])
    spread = np.maximum(spread, typical[:, None, None, None])
    kept = ~(np.abs(both - others) > OUTLYING * spread).any(axis=2)  # [D, S, K]
    # Scenes count with as many pairs as the one with the fewest; one without pairs is left out.
    fewest = np.where(kept.any(axis=2), kept.sum(axis=2), seeds).min(axis=1)
    used = kept & (kept.cumsum(axis=2) <= fewest[:, None, None])
    total = ((both[:, :, 1] - both[:, :, 0] + draws.effect) * used).sum(axis=(1, 2))
    return np.asarray(total / np.maximum(used.sum(axis=(1, 2)), 1))


def normal(
    rng: np.random.Generator, deviations: Array, seeds: int, draws: int, correlation: float = 0.0
) -> Draws:
    """Trainings of scenes and arms with these ``deviations`` [S, 2], in units of a pair's."""
    scale = deviations / math.sqrt(2)
    baseline = rng.standard_normal((draws, len(scale), MANY))
    arm = math.sqrt(1 - correlation**2) * rng.standard_normal((draws, len(scale), seeds))
    arm += correlation * baseline[..., :seeds]
    return Draws(baseline * scale[:, :1], arm * scale[:, 1:])


def rows(rng: np.random.Generator, draws: int) -> Iterator[tuple[str, Draws]]:
    """The rows of scripts/untruths.py without an effect, and two more."""
    equal, one = np.ones((3, 2)), np.array([[4.0, 4], [1, 1], [1, 1]])
    yield "normal", normal(rng, equal, 4, draws)
    yield "eight scenes", normal(rng, np.ones((8, 2)), 4, draws)
    yield "one scene four times as noisy", normal(rng, one, 4, draws)
    yield "one arm of it", normal(rng, np.where([False, True], one, 1), 4, draws)
    yield "2 pairs, one scene noisy", normal(rng, one, 2, draws)
    found = normal(rng, np.ones((8, 2)), 4, draws)
    own = np.where(rng.random((draws, 8)) < 1 / 8, 0.044, -0.0063) / 0.005
    yield "one stands out", Draws(found.baseline, found.arm + own[..., None], 0, own.mean(axis=1))
    found = normal(rng, equal, 4, draws)
    failed = [10 * (rng.random(one.shape) < 0.1) for one in (found.baseline, found.arm)]
    yield "either arm fails", Draws(found.baseline - failed[0], found.arm - failed[1])
    yield ONE_ARM, Draws(found.baseline, found.arm - failed[1], 0, -1.0)
    heavy = [rng.standard_t(3, (draws, 3, count)) / math.sqrt(6) for count in (MANY, 4)]
    yield "Student's t of 3 degrees", Draws(heavy[0], heavy[1])


def untrue(draws: Draws, rule: Rule) -> float:
    """The share of checks with a false sign, or with a false "too small", whichever is larger."""
    scenes, most = draws.arm.shape[1:]
    looks = LOOKS[: most - 1]
    outcomes, _ = decide(draws, rule, looks, look_levels(rule, scenes, looks, RATE / CLAIMS))
    truth = np.broadcast_to(draws.truth + draws.effect, outcomes.shape)
    signs = ((outcomes == SUPPORTED) & (truth <= 0)) | ((outcomes == REFUTED) & (truth >= 0))
    small = (outcomes == TOO_SMALL) & (np.abs(truth) >= LEAST)
    return max(float(one.reshape(-1, CLAIMS).any(axis=1).mean()) for one in (signs, small))


def false_signs(draws: Draws, rule: Rule) -> float:
    """The share of false signs at the last look alone, or over all looks, whichever is larger."""
    scenes, most = draws.arm.shape[1:]
    looks = tuple(range(2, most + 1))
    levels = look_levels(rule, scenes, looks, RATE)
    found = [
        significant(*draws.test(rule, seeds), level)
        for seeds, level in zip(looks, levels, strict=True)
    ]
    alone = significant(*draws.test(rule, looks[-1]), RATE)
    return max(float(np.any(found, axis=0).mean()), float(alone.mean()))


def grid(draws: int) -> Iterator[tuple[str, Draws]]:
    """The cells of scenes, seeds and noise of one scene, or of one arm of it."""
    rng = np.random.default_rng(1)
    for scenes in (1, 2, 3, 8, 13):
        for seeds in (2, 3, 4, 6):
            for noise, arms in ((1, 2), (3, 1), (3, 2), (10, 1), (10, 2)):
                deviations = np.ones((scenes, 2))
                deviations[0, 2 - arms :] = noise
                where = f"{scenes} × {seeds}, {noise}×" + " in one arm" * (arms == 1)
                yield where, normal(rng, deviations, seeds, draws)


def trainings(rule: Rule, draws: int, looks: tuple[int, ...], rate: float) -> float:
    """The mean trainings until a real effect of two deviations on three scenes is decided."""
    found = normal(np.random.default_rng(3), np.ones((3, 2)), looks[-1], draws)
    levels = look_levels(rule, 3, looks, rate)
    _, taken = decide(replace(found, effect=2.0), rule, looks, levels)
    return float(taken.mean()) * 3 * (1 if rule.baseline else 2)


def power(rule: Rule, draws: int, scenes: int, seeds: int) -> float:
    """The power at an effect of three standard errors."""
    found = normal(np.random.default_rng(4), np.ones((scenes, 2)), seeds, draws)
    found = replace(found, effect=3 / math.sqrt(scenes * seeds))
    return float(significant(*found.test(rule, seeds), RATE).mean())


def table(draws: int) -> str:
    """The table in Markdown: one row for each rule."""
    cells: dict[Rule, list[str]] = {rule: [rule.units, rule.name] for rule in RULES}
    in_grid: dict[Rule, list[tuple[float, str]]] = {rule: [] for rule in RULES}
    in_rows: dict[Rule, list[tuple[float, str]]] = {rule: [] for rule in RULES}
    one_arm: dict[Rule, list[str]] = {rule: [] for rule in RULES}
    for where, found in grid(draws):
        for rule in RULES:
            in_grid[rule].append((false_signs(found, rule), where))
    for where, found in rows(np.random.default_rng(2), draws):
        for effect in (0.0, 0.5, 1.0, 2.0):
            at = replace(found, effect=effect)
            for rule in RULES:
                share = untrue(at, rule)
                if where == ONE_ARM:
                    one_arm[rule].append(f"{100 * share:.1f}")
                else:
                    in_rows[rule].append((share, f"{where}, effect {effect:g}"))
    correlated = normal(np.random.default_rng(5), np.ones((8, 2)), 6, draws, -0.17)
    for rule, row in cells.items():
        for worst in (max(in_grid[rule]), max(in_rows[rule])):
            row.append(f"{100 * worst[0]:.1f} % ({worst[1]})")
        row.append(", ".join(one_arm[rule]))
        row.append(f"{100 * false_signs(correlated, rule):.1f} %")
        row.append(", ".join(f"{power(rule, draws, *at):.2f}" for at in ((3, 3), (3, 4), (8, 3))))
        many = trainings(rule, draws, LOOKS, RATE / CLAIMS), trainings(rule, draws, LONG, RATE)
        row.append(", ".join(f"{one:.1f}" for one in many))
    head = ["units", "degrees of freedom", "grid", "rows", ONE_ARM, "correlated", "power"]
    lines = [[*head, "trainings"], ["---"] * 8, *cells.values()]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=8000, help="in each cell and row")
    print(table(parser.parse_args().draws), end="")
