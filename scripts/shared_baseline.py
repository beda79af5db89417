"""Simulate arms that are declared after their baseline was measured, for findings/simulations.md.

    python scripts/shared_baseline.py                 write the table into the page (seconds)
    python scripts/shared_baseline.py --draws 2000    print it from fewer draws

No arm differs from the baseline, so each "better" or "worse" is false. The noise of trainings is
normal and independent. The rows say who saw what of the baseline before an arm was declared.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
import simulations
from numpy.typing import NDArray

from gsbench.analysis.statistics import ALPHA
from gsbench.analysis.thresholds import Region, evenness

SCENES = (1, 3)
HEAD = (
    "| the baseline | the arms | one scene: an arm's verdict is false | any of them | three "
    "scenes: an arm's | any of them |"
)

Array = NDArray[np.float64]
Baseline = Callable[[np.random.Generator, int, int], Array]


def p_values(differences: Array) -> Array:
    """The two-sided p [D] of differences [D, S, K], by the test of the verdicts."""
    _, scenes, seeds = differences.shape
    variances = differences.var(axis=2, ddof=1)  # [D, S]
    errors = np.sqrt(variances.sum(axis=1) / seeds) / scenes
    sizes = np.abs(differences.mean(axis=(1, 2))) / errors
    return Region(scenes, seeds, evenness(variances)).p_values(sizes)


def seen(seeds: int, kept: int) -> Baseline:
    """A baseline of ``seeds`` seeds; the arms get the ``kept`` seeds in which it is worst."""

    def draw(rng: np.random.Generator, draws: int, scenes: int) -> Array:
        values = rng.normal(size=(draws, scenes, seeds))
        worst = np.argsort(values.mean(axis=1), axis=1)[:, :kept]
        return np.take_along_axis(values, worst[:, None, :], axis=2)

    return draw


def rates(
    baseline: Baseline, arms: int, together: bool, draws: int, scenes: int
) -> tuple[float, float]:
    """The shares of false verdicts on one arm, and of experiments with a false one among all."""
    rng = np.random.default_rng(0)
    shared = baseline(rng, draws, scenes)
    p = np.stack([p_values(rng.normal(size=shared.shape) - shared) for _ in range(arms)])
    if not together:
        return float((p < ALPHA).mean()), float((p < ALPHA).any(axis=0).mean())
    ordered = np.sort(p, axis=0)
    limits = ALPHA / np.arange(arms, 0, -1)[:, None]
    rejected = np.cumprod(ordered < limits, axis=0)  # Holm
    return float(rejected.mean()), float(rejected.any(axis=0).mean())


ROWS: dict[tuple[str, str], tuple[Baseline, int, bool]] = {
    ("three seeds", "one"): (seen(3, 3), 1, False),
    ("three seeds", "four, declared by one command"): (seen(3, 3), 4, True),
    ("three seeds", "four, each by its own command"): (seen(3, 3), 4, False),
    ("three seeds", "ten, each by its own command"): (seen(3, 3), 10, False),
    ("four seeds, the worst three of them chosen", "one"): (seen(4, 3), 1, False),
    ("twelve seeds, the worst three of them chosen", "one"): (seen(12, 3), 1, False),
}


def table(draws: int) -> str:
    """The table in Markdown."""
    lines = [HEAD, "|---|---|---|---|---|---|"]
    for (baseline, arms), (draw, number, together) in ROWS.items():
        shares = [
            share for scenes in SCENES for share in rates(draw, number, together, draws, scenes)
        ]
        cells = " | ".join(f"{100 * share:.1f} %" for share in shares)
        lines.append(f"| {baseline} | {arms} | {cells} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, help="print the table from so many draws")
    options = parser.parse_args()
    if options.draws:
        print(table(options.draws), end="")
        return
    simulations.write_table("shared baseline", table(100_000))


if __name__ == "__main__":
    main()
