"""Simulated checks of claims whose truth is known: how often each verdict is wrong, for the table
of docs/verdict.md.

    python scripts/untruths.py                 write the table into the page (about ten minutes)
    python scripts/untruths.py --checks 200    print it from fewer checks

A check has four claims that share an error rate of 5 %. It looks at 2, 3 and 4 seeds, and trains no
further once a claim is decided. Differences are in standard deviations of a pair of trainings;
`LEAST` is the least effect that matters.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis import judgement
from gsbench.analysis.judgement import Verdict
from gsbench.analysis.pairing import Pairs, ScenePairs
from gsbench.analysis.quantities import asked_quantity
from gsbench.analysis.statistics import answer_family
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
    """Eight scenes of a population where one in eight gains .044 and the others lose .0063;
    deviations are .005."""
    rows, _, _ = normal(rng, 8)
    return rows, np.where(rng.random(8) < 1 / 8, 0.044, -0.0063) / 0.005, np.zeros(8)


def noisy(rng: np.random.Generator) -> tuple[list[Array], Array, Array]:
    return _normal(rng, [4] * 3, [4.0, 1.0, 1.0])


def failing(rng: np.random.Generator, arms: tuple[int, ...]) -> tuple[list[Array], Array, Array]:
    """One training in ten of each of these ``arms`` is worse by ten deviations, which changes the
    true mean."""
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


def rates(kind: Kind, effect: float, checks: int, seed: int = 0) -> Rates:
    """The rates over ``checks`` simulated checks. The real ``effect`` is in units of the least that
    matters."""
    rng = np.random.default_rng([seed, round(1000 * effect)])
    words = ("supported", "refuted", "too small to matter", "undecided")
    counts, untrue, like_these = dict.fromkeys(words, 0), dict.fromkeys(words[:3], 0), 0
    for _ in range(checks):
        claims = [_claim(kind, effect * LEAST, rng) for _ in range(kind.claims)]
        for verdict, _ in claims:
            counts[verdict.outcome] += 1
        for word in untrue:
            untrue[word] += any(
                v.outcome == word and not _is_true(word, truth) for v, truth in claims
            )
        median = effect * LEAST + kind.median
        like_these += any(
            v.like_these and not _is_true(v.like_these.outcome, median) for v, _ in claims
        )
    shares = {word: count / checks / kind.claims for word, count in counts.items()}
    return Rates(
        shares, {word: count / checks for word, count in untrue.items()}, like_these / checks
    )


def _is_true(word: str, truth: float) -> bool:
    """Return whether the verdict ``word`` on the claim "more" is right if ``truth`` is the real
    difference."""
    return {
        "supported": truth > 0,
        "refuted": truth < 0,
        "too small to matter": abs(truth) < LEAST,
    }.get(word, True)


def _claim(kind: Kind, effect: float, rng: np.random.Generator) -> tuple[Verdict, float]:
    """The verdict on one claim, and the true mean difference of its scenes."""
    rows, effects, shift = kind.draw(rng)
    pairs = Pairs(
        tuple(
            scene_pairs(k, row, effect + own)
            for k, (row, own) in enumerate(zip(rows, effects, strict=True))
        )
    )
    question = Question(metric="psnr", sign=1, least=LEAST)
    asked = Verdict(question, QUANTITY, pairs)
    truth = float(effect + effects.mean() + shift.mean())
    if kind.looks:
        return judgement._at_looks(asked, kind.looks, RATE / kind.claims), truth
    (answer,) = answer_family([pairs.differences], RATE / kind.claims)
    return judgement._decide(asked, answer), truth


def scene_pairs(place: int, noise: Array, effect: float) -> ScenePairs:
    count = noise.shape[1]
    trials: Any = tuple(
        (SimpleNamespace(path=Path(f"{place}/a{k}")), SimpleNamespace(path=Path(f"{place}/b{k}")))
        for k in range(count)
    )
    return ScenePairs(str(place), tuple(range(count)), trials, noise[0], noise[1] + effect)


QUANTITY = asked_quantity("psnr")
PAGE = Path(__file__).parents[1] / "docs" / "verdict.md"
SECTION = re.compile(r"(<!-- untruths -->\n).*?(<!-- end -->)", re.DOTALL)
EFFECTS = (0.0, 0.5, 1.0, 2.0)


def table(checks: int) -> str:
    """The table: for each kind of sweep and real effect, how often each verdict occurs, and how
    often it is wrong."""
    lines = [
        "| differences | effect | supported | refuted | too small | undecided | untrue: supported "
        "| refuted | "
    ]
    lines[0] += "too small | scenes like these |"
    lines.append("|" + "---|" * 10)
    for name, kind in KINDS.items():
        for effect in EFFECTS:
            measured = rates(kind, effect, checks)
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
        PAGE.write_text(
            SECTION.sub(lambda m: m[1] + made + m[2], PAGE.read_text(encoding="utf-8")),
            encoding="utf-8",
        )
    else:
        print(made, end="")
