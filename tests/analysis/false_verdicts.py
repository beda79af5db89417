"""How often verdicts are false where nothing is different: simulated sweeps of several arms in correlated metrics.

``python -m tests.analysis.false_verdicts`` prints the tables of docs/verdict.md.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gsbench.analysis.pairing import Paired
from gsbench.analysis.statistics import ALPHA, MIN_SCENES, Comparison, compare, compare_family

METRICS = 6  # PSNR, SSIM, FLIP and three LPIPS
SEEDS, VIEWS = 3, 8
TRIAL_NOISE, RESIDUAL = 0.1, 0.1
SCENE_NOISE = 0.15  # of an arm's effect in a scene, where there are scenes enough to ask about others
HEAD = "| arms | scenes | correlation | each metric by itself | declared | secondary | nothing declared, or late |"
SHAPE_HEAD = "| differences | 1 scene | 2 scenes | 4 scenes | 8 scenes |"

Array = np.ndarray


@dataclass(frozen=True)
class Rates:
    """Shares of sweeps with a false verdict: of any metric where each is tested by itself (``alone``); on the declared
    metric of any arm (``declared``); in any other metric of any arm (``secondary``); in one family of all (``all``)."""

    alone: float
    declared: float
    secondary: float
    all: float


def null_sweep(rng: np.random.Generator, arms: int, scenes: int, correlation: float) -> list[list[Paired]]:
    """Differences [metrics][arms - 1] of arms that do not differ from their baseline, which they share.

    ``correlation`` is that between two metrics of one trial. From ``MIN_SCENES`` on each scene has an effect of its
    own, of mean zero over scenes: what is said of these scenes may be true then, what is said of others is false.
    """

    def noise(*shape: int) -> Array:
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
        by_themselves = any(_is_false(compare(one, 1)) for one in every)
        counts += [by_themselves, _any_false(first), _any_false(others), _any_false(every)]
    return Rates(*(counts / simulations))


def _any_false(family: Sequence[Paired]) -> bool:
    return any(map(_is_false, compare_family([(paired, 1) for paired in family])))


def _is_false(comparison: Comparison) -> bool:
    """Whether the widest statement that can be made was made, where it is false."""
    if comparison.beyond is not None:
        return comparison.beyond.holds
    return comparison.verdict != "no evidence"


def normal(rng: np.random.Generator, scenes: int) -> Array:
    """Normal differences of pairs of trials, [scenes, SEEDS], of mean zero as all that follow."""
    return rng.normal(0, 1, (scenes, SEEDS))


def heavy(rng: np.random.Generator, scenes: int) -> Array:
    """Student's t with three degrees of freedom."""
    return rng.standard_t(3, (scenes, SEEDS))


def noisy_scene(rng: np.random.Generator, scenes: int) -> Array:
    """The first scene is four times as noisy as the others."""
    return rng.normal(0, 1, (scenes, SEEDS)) * np.where(np.arange(scenes) == 0, 4.0, 1.0)[:, None]


def disagreeing(rng: np.random.Generator, scenes: int) -> Array:
    """Effects of scenes from -1 to 1 deviation, of mean zero."""
    return rng.normal(0, 1, (scenes, SEEDS)) + np.linspace(-1, 1, scenes)[:, None] * (scenes > 1)


def skewed(rng: np.random.Generator, scenes: int) -> Array:
    """Exponential: the far values lie on one side."""
    return rng.exponential(1, (scenes, SEEDS)) - 1


SHAPES: dict[str, Callable[[np.random.Generator, int], Array]] = {
    "normal": normal,
    "heavy tails (t with 3 degrees)": heavy,
    "one scene four times as noisy": noisy_scene,
    "scenes disagree": disagreeing,
    "skewed (exponential)": skewed,
}


def shape_rate(shape: str, scenes: int, simulations: int) -> float:
    """How often a single comparison of these scenes is decided, though the mean difference is zero."""
    rng = np.random.default_rng([scenes, len(shape)])
    wrong = 0
    for _ in range(simulations):
        matrices = tuple(row[:, None] for row in SHAPES[shape](rng, scenes))
        p = compare(Paired("m", tuple(map(str, range(scenes))), matrices, 25.0, ()), 1).p
        wrong += p is not None and p < ALPHA
    return wrong / simulations


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--simulations", type=int, default=1000)
    simulations = parser.parse_args().simulations
    print(HEAD, "|---" * HEAD.count("| ") + "|", sep="\n", flush=True)
    for arms, scenes, correlation in itertools.product((2, 3, 5), (1, 3, 9), (0.0, 0.7)):
        rates = measure(arms, scenes, correlation, simulations)
        shown = [f"{100 * rate:.1f} %" for rate in (rates.alone, rates.declared, rates.secondary, rates.all)]
        print("|", " | ".join([str(arms), str(scenes), str(correlation), *shown]), "|", flush=True)
    print("", SHAPE_HEAD, "|---" * SHAPE_HEAD.count("| ") + "|", sep="\n", flush=True)
    for shape in SHAPES:
        shown = [f"{100 * shape_rate(shape, scenes, 4 * simulations):.1f} %" for scenes in (1, 2, 4, 8)]
        print("|", " | ".join([shape, *shown]), "|", flush=True)


if __name__ == "__main__":
    main()
