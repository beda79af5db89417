"""Simulated nights of ideas: how many kept ideas are no better, and how many good ones are kept.

    python scripts/ledger_rates.py                 write findings/simulations.md (three minutes)
    python scripts/ledger_rates.py --nights 100    print the tables from fewer nights

A night tries forty ideas on three scenes with up to six seeds. All are compared with the same
trainings of one baseline. Differences are in standard deviations of a pair of trainings. In an
adaptive night, every second idea (by chance) is another try of what has the largest mean so far, as
the ledger shows it, with the same effect and new trainings.
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

from gsbench.analysis.looks import look_levels, plan_looks
from gsbench.analysis.thresholds import Region, evenness
from gsbench.claims.ledger import GIVE_UP, RETRIES

IDEAS, RATE = 40, 0.1
SCENES, SEEDS = 3, 6
LOOKS = plan_looks(SEEDS)
NIGHTS, MANY_NIGHTS = 2000, 8000
NAIVE_SEEDS = 3

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
# From the differences [N, SCENES, SEEDS], the numbers of ideas kept so far [N] and the least
# difference that matters: which are kept, and the number of seeds that were trained [N].
Rule = Callable[[Array, NDArray[np.int64], float], tuple[Mask, NDArray[np.int64]]]


def in_looks(
    differences: Array, kept: NDArray[np.int64], least: float, lond: bool
) -> tuple[Mask, NDArray[np.int64]]:
    """The ledger's rule, restated for many nights at once; without ``lond`` Bonferroni's levels."""
    count = len(differences)
    level = 2 * RATE / IDEAS * ((kept + 1) if lond else np.ones(count))  # both sides
    level = level / RETRIES
    undecided, keep = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
    seeds = np.full(count, LOOKS[-1])
    for number, look in enumerate(LOOKS):
        rows = differences[:, :, :look]
        mean, variances = rows.mean(axis=(1, 2)), rows.var(axis=2, ddof=1)
        scenes = rows.shape[1]
        error = np.sqrt(variances.sum(axis=1) / look) / scenes
        region = Region(scenes, look, evenness(variances))
        half = np.zeros(count)
        for one in np.unique(level):
            at_look = look_levels(scenes, LOOKS, float(one))[number]
            half = np.where(level == one, region.limits(at_look) * error, half)
        within = np.maximum(half - mean, half + mean) < least
        hopeless = mean + region.limits(2 * GIVE_UP) * error < least
        better = undecided & (mean > half) & ~within
        ends = better | (undecided & ((mean < -half) | within | hopeless))
        keep |= better
        seeds[ends] = look
        undecided &= ~ends
    return keep, seeds


def by_mean(
    differences: Array, kept: NDArray[np.int64], least: float, part: float
) -> tuple[Mask, NDArray[np.int64]]:
    """Keep an idea if its mean over three seeds is above a ``part`` of ``least``."""
    keep = differences[:, :, :NAIVE_SEEDS].mean(axis=(1, 2)) > part * least
    return keep, np.full(len(keep), NAIVE_SEEDS)


RULES: Mapping[str, Rule] = {
    "the ledger": partial(in_looks, lond=True),
    "Bonferroni": partial(in_looks, lond=False),
    "mean of three seeds above 0": partial(by_mean, part=0.0),
    "mean of three seeds above the least": partial(by_mean, part=1.0),
}


@dataclass(frozen=True)
class Rates:
    """Rates of a rule over many nights."""

    false: float  # share of kept ideas that are no better
    found: float  # share of good ideas that are kept
    seeds: float  # trained for an idea


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
    kept, false, good, found, trained = (np.zeros(nights, dtype=np.int64) for _ in range(5))
    best, best_effect = np.full(nights, -np.inf), np.zeros(nights)
    best_noise, own_part = np.zeros(shape), math.sqrt(1 - night.correlation**2)
    for _ in range(IDEAS):
        own = np.where(rng.random(nights) < night.real, night.effect * night.least, 0.0)
        noise = rng.standard_normal(shape)
        retry = (rng.random(nights) < night.retried) & np.isfinite(best)
        own = np.where(retry, best_effect, own)
        alike = night.correlation * best_noise + own_part * noise
        noise = np.where(retry[:, None, None], alike, noise)
        differences = own[:, None, None] + scale * noise - baseline
        keep, seeds = rule(differences, kept, night.least)
        looks = _sizes(differences, seeds) if night.by_size else _means(differences, seeds)
        ahead = (looks > best) & ~keep
        best, best_effect = np.where(ahead, looks, best), np.where(ahead, own, best_effect)
        best_noise = np.where(ahead[:, None, None], noise, best_noise)
        kept += keep
        false += keep & (own == 0)
        good += own > 0
        found += keep & (own > 0)
        trained += seeds
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


def choices(nights: int) -> str:
    """The table on what is tried again: the share of false discoveries, no idea being good."""
    heads = ["retries correlate by", "captures", "retried: largest mean", "most standard errors"]
    lines = [f"| {' | '.join(heads)} |", f"|{' --- |' * len(heads)}"]
    for captures, correlation in product((1, 3), (0.0, 0.39, 0.7, 0.8, 0.95)):
        noise = (1.0,) * captures
        cells = [f"{correlation:g}", str(captures)]
        for by_size in (False, True):
            night = Night(0.5, 0.0, 0.0, 0.7, correlation, noise, by_size)
            cells.append(f"{100 * simulate(RULES['the ledger'], night, nights).false:.1f} %")
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
    for name, make, most in (("rates", table, NIGHTS), ("retries", choices, MANY_NIGHTS)):
        text = make(nights or most)
        if nights:
            print(text)
        else:
            simulations.write_table(name, text)


if __name__ == "__main__":
    main()
