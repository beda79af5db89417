"""Simulated nights of ideas: how many kept ideas are no better, and how many good ones are kept.

    python scripts/ledger_rates.py                 write findings/simulations.md (ten minutes)
    python scripts/ledger_rates.py --nights 100    print the tables from fewer nights

A night tries forty ideas on three scenes with up to six seeds. All are compared with the same
trainings of one baseline; what looks better is tested on new seeds. Differences are in standard
deviations of a pair of trainings. In an adaptive night, every second idea (by chance) is another
try of what looks best so far, as the ledger shows it, with the same effect and new trainings.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
import simulations
from numpy.typing import NDArray

from gsbench.analysis.questions import look_shares, plan_looks
from gsbench.analysis.statistics import Region, evenness
from gsbench.analysis.verdicts import GIVE_UP
from gsbench.claims.ledger import SCREEN

IDEAS, RATE = 40, 0.1
SCENES, SEEDS = 3, 6
LOOKS = plan_looks(SEEDS)
NIGHTS = 2000
NAIVE_SEEDS = 3

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Attempt:
    """An idea in each of N nights.

    ``shared`` and ``new`` [N, SCENES, SEEDS] are its differences on the seeds of all ideas and on
    those of its test. ``kept`` and ``tests`` [N] count the ideas before it, ``least`` is the least
    difference that matters.
    """

    shared: Array
    new: Array
    kept: NDArray[np.int64]
    tests: NDArray[np.int64]
    least: float


@dataclass(frozen=True)
class Decided:
    """The answer of a rule [N]: ``keep`` and ``test`` are masks.

    ``seeds`` were trained on, and ``tested`` new ones by the idea and the baseline.
    """

    keep: Mask
    seeds: NDArray[np.int64]
    test: Mask
    tested: NDArray[np.int64]


Rule = Callable[[Attempt], Decided]


def in_tests(attempt: Attempt, screen: float = SCREEN, equal: bool = False) -> Decided:
    """The ledger's rule, restated; with ``equal`` all its tests have the same weight."""
    count = len(attempt.kept)
    passes, seeds = in_looks(attempt.shared, np.full(count, 2 * screen), attempt.least)
    numbers = attempt.tests + 1
    weight = 1 / IDEAS if equal else 1 / numbers / (1 / np.arange(1, IDEAS + 1)).sum()
    level = np.broadcast_to(RATE * (attempt.kept + 1) * weight, (count,))
    keep, tested = in_looks(attempt.new[passes], 2 * level[passes], attempt.least)
    kept, new = np.zeros(count, dtype=bool), np.zeros(count, dtype=np.int64)
    kept[passes], new[passes] = keep, tested
    return Decided(kept, seeds, passes, new)


def on_shared_seeds(attempt: Attempt) -> Decided:
    """LOND with equal weights, on the seeds of all ideas."""
    keep, seeds = in_looks(attempt.shared, 2 * RATE / IDEAS * (attempt.kept + 1.0), attempt.least)
    return Decided(keep, seeds, np.zeros_like(keep), np.zeros_like(seeds))


def in_looks(differences: Array, levels: Array, least: float) -> tuple[Mask, NDArray[np.int64]]:
    """Mask of ideas that are better in looks at ``levels`` [N] (both sides), and seeds trained."""
    count = len(differences)
    undecided, keep = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
    seeds = np.full(count, LOOKS[-1])
    scenes = differences.shape[1]
    for number, look in enumerate(LOOKS):
        rows = differences[:, :, :look]
        mean, variances = rows.mean(axis=(1, 2)), rows.var(axis=2, ddof=1)
        error = np.sqrt(variances.sum(axis=1) / look) / scenes
        even = evenness(variances)
        half = np.zeros(count)
        for level in np.unique(levels):
            own = levels == level
            at_look = float(level) * look_shares(len(LOOKS))[number]
            half[own] = Region(scenes, look, even[own]).limits(at_look) * error[own]
        within = np.maximum(half - mean, half + mean) < least
        hopeless = mean + Region(scenes, look, even).limits(2 * GIVE_UP) * error < least
        better = undecided & (mean > half) & ~within
        ends = better | (undecided & ((mean < -half) | within | hopeless))
        keep |= better
        seeds[ends] = look
        undecided &= ~ends
    return keep, seeds


def by_mean(attempt: Attempt, part: float) -> Decided:
    """Keep an idea if its mean over three seeds is above a ``part`` of ``least``."""
    mean = attempt.shared[:, :, :NAIVE_SEEDS].mean(axis=(1, 2))
    none = np.zeros(len(mean), dtype=np.int64)
    return Decided(mean > part * attempt.least, none + NAIVE_SEEDS, none > 0, none)


RULES: Mapping[str, Rule] = {
    "the ledger": in_tests,
    "LOND on shared seeds": on_shared_seeds,
    "mean of three seeds above 0": partial(by_mean, part=0.0),
    "mean of three seeds above the least": partial(by_mean, part=1.0),
}


@dataclass(frozen=True)
class Rates:
    """Rates of a rule over many nights."""

    false: float  # share of kept ideas that are no better
    found: float  # share of good ideas that are kept
    seeds: float  # trained for an idea, those of the baseline in tests too


@dataclass(frozen=True)
class Night:
    """A kind of night: how ideas are chosen, and on what.

    A share ``real`` of the ideas gains ``effect`` times ``least``. A share ``retried`` of them are
    another try of what looked best so far, with the same effect; their noise correlates with that
    of the first try. The best has the largest mean, or (``by_size``) the largest mean in standard
    errors. ``noise`` has the deviations of the captures.
    """

    least: float
    real: float = 0.0
    effect: float = 0.0
    retried: float = 0.0
    correlation: float = 0.0
    noise: tuple[float, ...] = (1.0,) * SCENES
    by_size: bool = False


def simulate(rule: Rule, night: Night, nights: int) -> Rates:
    """Simulate such nights."""
    rng = np.random.default_rng([round(100 * night.real), round(10 * night.effect)])
    scale = 0.5**0.5 * np.array(night.noise)[:, None]
    shape = (nights, len(night.noise), SEEDS)
    baseline = scale * rng.standard_normal(shape)
    kept, tests, false, good, found, trained = (np.zeros(nights, dtype=np.int64) for _ in range(6))
    best, best_effect = np.full(nights, -np.inf), np.zeros(nights)
    best_noise, own_part = np.zeros(shape), math.sqrt(1 - night.correlation**2)
    for _ in range(IDEAS):
        own = np.where(rng.random(nights) < night.real, night.effect * night.least, 0.0)
        noise = rng.standard_normal(shape)
        retry = (rng.random(nights) < night.retried) & np.isfinite(best)
        own = np.where(retry, best_effect, own)
        alike = night.correlation * best_noise + own_part * noise
        noise = np.where(retry[:, None, None], alike, noise)
        shared = own[:, None, None] + scale * noise - baseline
        new = own[:, None, None] + scale * math.sqrt(2) * rng.standard_normal(shape)
        decided = rule(Attempt(shared, new, kept, tests, night.least))
        keep = decided.keep
        looks = (_sizes if night.by_size else _means)(shared, decided.seeds)
        ahead = (looks > best) & ~keep
        best, best_effect = np.where(ahead, looks, best), np.where(ahead, own, best_effect)
        best_noise = np.where(ahead[:, None, None], noise, best_noise)
        kept += keep
        tests += decided.test
        false += keep & (own == 0)
        good += own > 0
        found += keep & (own > 0)
        trained += decided.seeds + 2 * decided.tested
    return Rates(
        float((false / np.maximum(kept, 1)).mean()),
        float(found.sum() / good.sum()) if good.any() else float("nan"),
        float(trained.mean() / IDEAS),
    )


def _means(differences: Array, seeds: NDArray[np.int64]) -> Array:
    """The means [N] over the seeds that were trained."""
    trained = np.arange(differences.shape[2]) < seeds[:, None, None]
    return np.asarray((differences * trained).sum(axis=(1, 2)) / seeds / differences.shape[1])


def _sizes(differences: Array, seeds: NDArray[np.int64]) -> Array:
    """The same in standard errors."""
    trained = np.arange(differences.shape[2]) < seeds[:, None, None]
    each = (differences * trained).sum(axis=2, keepdims=True) / seeds[:, None, None]
    squares = (((differences - each) ** 2) * trained).sum(axis=(1, 2))
    error = np.sqrt(squares / (seeds - 1) / seeds) / differences.shape[1]
    return _means(differences, seeds) / error


WAYS = {  # share that is tried again, and whether the best has the most standard errors
    "70 %, largest mean": (0.7, False),
    "70 %, most standard errors": (0.7, True),
    "90 %, most standard errors": (0.9, True),
}


def choices(nights: int) -> str:
    """The table on what is tried again: the share of false discoveries, no idea being good."""
    heads = ["captures", "retries correlate by", "rule", *WAYS]
    lines = [f"| {' | '.join(heads)} |", f"|{' --- |' * len(heads)}"]
    for captures, correlation in product((1, 3), (0.0, 0.7, 0.95)):
        for name in ("the ledger", "LOND on shared seeds"):
            cells = [str(captures), f"{correlation:g}", name]
            for share, by_size in WAYS.values():
                noise = (1.0,) * captures
                night = Night(0.5, 0.0, 0.0, share, correlation, noise, by_size)
                cells.append(f"{100 * simulate(RULES[name], night, nights).false:.1f} %")
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def screens(nights: int) -> str:
    """The table on who passes on to a test, and on the weights of tests."""
    cases = {
        "20 % gain the least": Night(1.0, 0.2, 1.0),
        "5 % gain the least": Night(1.0, 0.05, 1.0),
        "20 % gain twice the least of half a deviation": Night(0.5, 0.2, 2.0),
    }
    heads = ["passes by chance", "weights", *cases]
    lines = [f"| {' | '.join(heads)} |", f"|{' --- |' * len(heads)}"]
    for screen, equal in product((0.05, 0.1, 0.2), (False, True)):
        cells = [f"{100 * screen:g} %", "equal" if equal else "1/n"]
        for night in cases.values():
            rates = simulate(partial(in_tests, screen=screen, equal=equal), night, nights)
            cells.append(f"{100 * rates.found:.0f} · {rates.seeds:.1f}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def table(nights: int) -> str:
    """The table of rates in Markdown."""
    heads = ["least", "good ideas", "gain", "next idea", *RULES]
    lines = [f"| {' | '.join(heads)} |", f"|{' --- |' * len(heads)}"]
    cases = [(0.0, 0.0), *((real, effect) for real in (0.05, 0.2) for effect in (0.5, 1.0, 2.0))]
    for least, (real, effect), adaptive in product((0.5, 1.0), cases, (False, True)):
        cells = [f"{least:g}", f"{100 * real:.0f} %", f"{effect:g}" if real else ""]
        cells.append("by results" if adaptive else "any")
        for rule in RULES.values():
            rates = simulate(rule, Night(least, real, effect, 0.5 * adaptive), nights)
            found = f" · {100 * rates.found:.0f}" if real else ""
            cells.append(f"{100 * rates.false:.1f}{found} · {rates.seeds:.1f}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--nights", type=int)
    nights = parser.parse_args().nights
    tables = (("rates", table, NIGHTS), ("retries", choices, NIGHTS), ("screens", screens, NIGHTS))
    for name, make, most in tables:
        text = make(nights or most)
        if nights:
            print(text)
        else:
            simulations.write_table(name, text)


if __name__ == "__main__":
    main()
