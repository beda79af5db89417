"""Simulate checks of claims whose truth is known, for findings/simulations.md.

    python scripts/untruths.py                 write the table into the page (two minutes)
    python scripts/untruths.py --checks 200    print it from fewer checks

The table says how often each verdict is wrong. A check has four claims that share an error rate of
5 %. It looks at 2, 3 and 4 seeds, and trains no further once a claim is decided. Differences are in
standard deviations of a pair of trainings; `LEAST` is the least effect that matters. The table is
made by the fast simulator of ``decision_rules.py``, which decides as the judge does (the tests
compare them).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import simulations
from decision_rules import CHOSEN, Draws, decide
from numpy.typing import NDArray

from gsbench.analysis import judgement
from gsbench.analysis.judgement import Verdict
from gsbench.analysis.looks import look_levels
from gsbench.analysis.pairing import Pairs, ScenePairs
from gsbench.analysis.quantities import asked_quantity
from gsbench.analysis.statistics import answer_family, judge_like_these
from gsbench.runs.experiments import Question

CLAIMS, RATE = 4, 0.05
LOOKS = (2, 3, 4)
LEAST = 1.0

Array = NDArray[np.float64]
# Draws, for each scene: the noise of both arms [2, K], the scene's own effect, and the mean of its
# noise.
Draw = Callable[[np.random.Generator], tuple[list[Array], Array, Array]]


@dataclass(frozen=True)
class Kind:
    """A kind of sweep to simulate."""

    draw: Draw
    looks: tuple[int, ...] = LOOKS  # numbers of seeds; none: all trials are judged once
    median: float = 0.0  # of the own effects of scenes like these
    claims: int = CLAIMS


@dataclass(frozen=True)
class Rates:
    """Rates at which verdicts occur and are wrong."""

    outcomes: dict[str, float]  # share of claims with each verdict
    untrue: dict[str, float]  # share of checks that give a claim this verdict wrongly
    like_these: float  # share of checks with a wrong verdict about scenes like these


def _normal(
    rng: np.random.Generator, counts: Sequence[int], noise: Sequence[float]
) -> tuple[list[Array], Array, Array]:
    rows = [
        rng.normal(0, scale / 2**0.5, (2, count))
        for count, scale in zip(counts, noise, strict=True)
    ]
    return rows, np.zeros(len(counts)), np.zeros(len(counts))


def normal(rng: np.random.Generator, scenes: int = 3) -> tuple[list[Array], Array, Array]:
    return _normal(rng, [LOOKS[-1]] * scenes, [1.0] * scenes)


def standing_out(rng: np.random.Generator) -> tuple[list[Array], Array, Array]:
    """Eight scenes of a population where one in eight gains .044 and the others lose .0063.

    The deviation of a pair of trainings is .005.
    """
    rows, _, _ = normal(rng, 8)
    return rows, np.where(rng.random(8) < 1 / 8, 0.044, -0.0063) / 0.005, np.zeros(8)


def noisy(rng: np.random.Generator) -> tuple[list[Array], Array, Array]:
    return _normal(rng, [4] * 3, [4.0, 1.0, 1.0])


def failing(rng: np.random.Generator, arms: tuple[int, ...]) -> tuple[list[Array], Array, Array]:
    """One training in ten of each of these ``arms`` is worse by ten deviations.

    That changes the true mean.
    """
    rows, effects, _ = normal(rng)
    for row in rows:
        for arm in arms:
            row[arm] -= 10 * (rng.random(row.shape[1]) < 0.1)
    return rows, effects, np.full(3, {(0, 1): 0.0, (1,): -1.0}[arms])


def uneven(rng: np.random.Generator) -> tuple[list[Array], Array, Array]:
    return _normal(rng, [2, 10, 10], [4.0, 1.0, 1.0])


KINDS = {
    "normal": Kind(normal),
    "normal, eight scenes": Kind(lambda rng: normal(rng, 8)),
    "one scene four times as noisy": Kind(noisy),
    "one scene in eight stands out": Kind(standing_out, median=-0.0063 / 0.005),
    "a training in ten fails, either arm": Kind(lambda rng: failing(rng, (0, 1))),
    "a training in ten fails, one arm": Kind(lambda rng: failing(rng, (1,))),
    "2, 10 and 10 pairs, the small scene noisy": Kind(uneven, looks=()),
}


def rates(kind: Kind, effect: float, checks: int, seed: int = 0, fast: bool = False) -> Rates:
    """The rates over ``checks`` simulated checks, by the judge or by the ``fast`` simulator.

    The real ``effect`` is in units of the least that matters.
    """
    rng = np.random.default_rng([seed, round(1000 * effect)])
    drawn = [kind.draw(rng) for _ in range(checks * kind.claims)]
    real = effect * LEAST
    truths = [float(real + own.mean() + shift.mean()) for _, own, shift in drawn]
    decided = (_simulated if fast and kind.looks else _judged)(kind, drawn, real)

    def in_checks(wrong: list[bool]) -> float:
        return float(np.reshape(wrong, (checks, kind.claims)).any(axis=1).mean())

    found = [outcome for outcome, _ in decided]
    untrue = {
        word: in_checks(
            [
                one == word and not _is_true(word, truth)
                for one, truth in zip(found, truths, strict=True)
            ]
        )
        for word in WORDS[:3]
    }
    like_these = in_checks([not _is_true(like, real + kind.median) for _, like in decided])
    return Rates({word: found.count(word) / len(found) for word in WORDS}, untrue, like_these)


WORDS = ("supported", "refuted", "too small to matter", "undecided")
CODES = ("undecided", *WORDS)  # by the simulator's numbers
Drawn = Sequence[tuple[list[Array], Array, Array]]


def _judged(kind: Kind, drawn: Drawn, effect: float) -> list[tuple[str, str]]:
    """The outcomes on these scenes and on scenes like these, by the judge."""
    verdicts = [_claim(kind, rows, effect + own) for rows, own, _ in drawn]
    return [
        (one.outcome, one.like_these.outcome if one.like_these else "undecided") for one in verdicts
    ]


def _simulated(kind: Kind, drawn: Drawn, effect: float) -> list[tuple[str, str]]:
    """The same, by the fast simulator."""
    both = np.array([rows for rows, _, _ in drawn])  # [D, S, 2, K]
    arm = both[:, :, 1] + np.array([own for _, own, _ in drawn])[..., None]
    draws = Draws(both[:, :, 0], arm, effect)
    levels = look_levels(arm.shape[1], kind.looks, RATE / kind.claims)
    outcomes, taken = decide(draws, CHOSEN, kind.looks, levels)
    means = [
        (arm[k, :, :seeds] - draws.baseline[k, :, :seeds]).mean(axis=1) + effect
        for k, seeds in enumerate(taken)
    ]
    like = [judge_like_these(mean, 1, LEAST, RATE / kind.claims) for mean in means]
    return [
        (CODES[code], one.outcome if one else "undecided")
        for code, one in zip(outcomes, like, strict=True)
    ]


def _is_true(word: str, truth: float) -> bool:
    """Return whether the verdict ``word`` on the claim "more" is right for the real difference."""
    return {
        "supported": truth > 0,
        "refuted": truth < 0,
        "too small to matter": abs(truth) < LEAST,
    }.get(word, True)


def _claim(kind: Kind, rows: list[Array], effects: Array) -> Verdict:
    """The verdict on one claim."""
    pairs = Pairs(
        tuple(
            scene_pairs(k, row, effect)
            for k, (row, effect) in enumerate(zip(rows, effects, strict=True))
        )
    )
    question = Question(metric="psnr", sign=1, least=LEAST)
    asked = Verdict(question, QUANTITY, pairs)
    if kind.looks:
        return judgement._at_looks(asked, kind.looks, RATE / kind.claims)
    (answer,) = answer_family([pairs.differences], RATE / kind.claims)
    return judgement._decide(asked, answer)


def scene_pairs(place: int, noise: Array, effect: float) -> ScenePairs:
    count = noise.shape[1]
    trials: Any = tuple(
        (SimpleNamespace(path=Path(f"{place}/a{k}")), SimpleNamespace(path=Path(f"{place}/b{k}")))
        for k in range(count)
    )
    return ScenePairs(str(place), tuple(range(count)), trials, noise[0], noise[1] + effect)


QUANTITY = asked_quantity("psnr")
EFFECTS = (0.0, 0.5, 1.0, 2.0)


def table(checks: int) -> str:
    """The table: how often each verdict occurs and is wrong, by kind of sweep and real effect."""
    lines = [
        "| differences | effect | supported | refuted | too small | undecided | untrue: supported "
        "| refuted | "
    ]
    lines[0] += "too small | scenes like these |"
    lines.append("|" + "---|" * 10)
    for name, kind in KINDS.items():
        for effect in EFFECTS:
            measured = rates(kind, effect, checks, fast=True)
            shares = [*measured.outcomes.values(), *measured.untrue.values(), measured.like_these]
            lines.append(
                f"| {name} | {effect:g} | "
                + " | ".join(f"{100 * share:.1f} %" for share in shares)
                + " |"
            )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--checks", type=int, help="print the table from this many checks a row; the page stays"
    )
    wanted = parser.parse_args().checks
    made = table(wanted or 3000)
    if wanted is None:
        simulations.write_table("untruths", made)
    else:
        print(made, end="")
