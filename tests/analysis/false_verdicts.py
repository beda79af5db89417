"""How often verdicts are false where nothing is different: simulated sweeps of several arms in correlated metrics.

``python -m tests.analysis.false_verdicts`` prints the table of docs/verdict.md.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsbench.analysis.pairing import Paired
from gsbench.analysis.statistics import MIN_SCENES, compare, compare_family

METRICS = 6  # PSNR, SSIM, FLIP and three LPIPS
SEEDS, VIEWS = 3, 8
BOOTSTRAP = 300
TRIAL_NOISE, RESIDUAL = 0.1, 0.1
SCENE_NOISE = 0.15  # of an arm's effect in a scene, where scenes are the units
HEAD = "| arms | scenes | correlation | nothing declared | declared | secondary | declared late |"


@dataclass(frozen=True)
class Rates:
    """Shares of sweeps with a false verdict: of any metric where none was declared (``none``); on the declared metric
    of any arm (``declared``); in any other metric of any arm (``secondary``); in one family of all (``late``)."""

    none: float
    declared: float
    secondary: float
    late: float


def null_sweep(rng: np.random.Generator, arms: int, scenes: int, correlation: float) -> list[list[Paired]]:
    """Differences [metrics][arms - 1] of arms that do not differ from their baseline, which they share.

    ``correlation`` is that between two metrics of one trial. Where scenes are the units, each has an effect of its own.
    """

    def noise(*shape: int) -> np.ndarray:
        """Correlated along the first axis, which is the metrics'."""
        common = rng.normal(0, 1, shape[1:])
        return np.sqrt(correlation) * common + np.sqrt(1 - correlation) * rng.normal(0, 1, shape)

    values = TRIAL_NOISE * noise(METRICS, arms, scenes, SEEDS, 1) + RESIDUAL * noise(
        METRICS, arms, scenes, SEEDS, VIEWS
    )
    if scenes >= MIN_SCENES:
        values = values + SCENE_NOISE * noise(METRICS, arms, scenes, 1, 1)
    differences = values[:, 1:] - values[:, :1]  # [metrics, arms - 1, scenes, seeds, views]
    names = tuple(f"s{k}" for k in range(scenes))
    return [[Paired("m", names, tuple(matrices), 25.0, ()) for matrices in of_metric] for of_metric in differences]


def measure(arms: int, scenes: int, correlation: float, simulations: int, seed: int = 0) -> Rates:
    """The rates over ``simulations`` sweeps; the declared metric is the first."""
    rng = np.random.default_rng([seed, arms, scenes, int(100 * correlation)])
    counts = np.zeros(4)
    for _ in range(simulations):
        sweep = null_sweep(rng, arms, scenes, correlation)
        every = list(itertools.chain.from_iterable(sweep))
        first, others = every[: arms - 1], every[arms - 1 :]
        by_themselves = any(compare(one, 1, BOOTSTRAP).verdict != "no evidence" for one in every)
        counts += [by_themselves, _any_verdict(first), _any_verdict(others), _any_verdict(every)]
    return Rates(*(counts / simulations))


def _any_verdict(family: Sequence[Paired]) -> bool:
    return any(one.verdict != "no evidence" for one in compare_family([(paired, 1) for paired in family], BOOTSTRAP))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--simulations", type=int, default=1000)
    simulations = parser.parse_args().simulations
    print(HEAD, "|---" * HEAD.count("| ") + "|", sep="\n", flush=True)
    for arms, scenes, correlation in itertools.product((2, 3, 5), (1, 3, 9), (0.0, 0.7)):
        rates = measure(arms, scenes, correlation, simulations)
        shown = [f"{100 * rate:.1f} %" for rate in (rates.none, rates.declared, rates.secondary, rates.late)]
        print("|", " | ".join([str(arms), str(scenes), str(correlation), *shown]), "|", flush=True)


if __name__ == "__main__":
    main()
