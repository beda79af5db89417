"""Simulated checks of claims whose truth is known: how often each word is untrue, for the table of docs/verdict.md.

    python scripts/untruths.py                 write the table into the page (about ten minutes)
    python scripts/untruths.py --checks 200    print it from fewer checks

A check has four claims that share 5 %, looks at 2, 3 and 4 seeds, and trains no further once a claim is decided.
Differences are in deviations of a pair of trainings; the least effect that matters is `LEAST` of them.
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
from gsbench.runs.declaration import Question

CLAIMS, RATE = 4, 0.05
LOOKS = (2, 3, 4)
LEAST = 1.0

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], tuple[list[Array], Array, Array]]  # noise of both arms [K] by scene; effects


@dataclass(frozen=True)
class Kind:
    """A kind of sweep: ``draw`` gives for each scene both arms' noise, and the scenes' own effects beside the common
    one.

    ``median`` is that of the effects of scenes like these, ``looks`` are planned; none: all is judged once.
    """

    draw: Draw
    looks: tuple[int, ...] = LOOKS
    median: float = 0.0
    claims: int = CLAIMS


@dataclass(frozen=True)
class Rates:
    """Shares of checks: ``told``, with which each word was said of a claim; ``untrue``, in which it was said untruly of
    any.

    ``like_these``: in which any of the words about scenes like these was untrue.
    """

    told: dict[str, float]
    untrue: dict[str, float]
    like_these: float


def _normal(
    rng: np.random.Generator, counts: Sequence[int], noise: Sequence[float]
) -> tuple[list[Array], Array, Array]:
    rows = [rng.normal(0, scale / 2**0.5, (2, count)) for count, scale in zip(counts, noise, strict=True)]
    return rows, np.zeros(len(counts)), np.zeros(len(counts))


def normal(rng: np.random.Generator, scenes: int = 3) -> tuple[list[Array], Array, Array]:
    return _normal(rng, [LOOKS[-1]] * scenes, [1.0] * scenes)


def standing_out(rng: np.random.Generator) -> tuple[list[Array], Array, Array]:
    """Eight scenes, drawn from many of which one in eight gains .044 and the others lose .0063, in deviations of
    .005."""
    rows, _, _ = normal(rng, 8)
    return rows, np.where(rng.random(8) < 1 / 8, 0.044, -0.0063) / 0.005, np.zeros(8)


def noisy(rng: np.random.Generator) -> tuple[list[Array], Array, Array]:
    return _normal(rng, [4] * 3, [4.0, 1.0, 1.0])


def failing(rng: np.random.Generator, arms: tuple[int, ...]) -> tuple[list[Array], Array, Array]:
    """One training in ten of each of these ``arms`` goes wrong by ten deviations, which counts as effect in the
    mean."""
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
    """The rates over ``checks`` simulated checks at a real ``effect`` of so many times the least that matters."""
    rng = np.random.default_rng([seed, round(1000 * effect)])
    words = ("supported", "refuted", "too small to matter", "undecided")
    told, untrue, beyond = dict.fromkeys(words, 0), dict.fromkeys(words[:3], 0), 0
    for _ in range(checks):
        found = [_claim(kind, effect * LEAST, rng) for _ in range(kind.claims)]
        for verdict, _ in found:
            told[verdict.outcome] += 1
        for word in untrue:
            untrue[word] += any(v.outcome == word and not _is_true(word, truth) for v, truth in found)
        median = effect * LEAST + kind.median
        beyond += any(v.like_these and not _is_true(v.like_these.outcome, median) for v, _ in found)
    shares = {word: count / checks / kind.claims for word, count in told.items()}
    return Rates(shares, {word: count / checks for word, count in untrue.items()}, beyond / checks)


def _is_true(word: str, truth: float) -> bool:
    """Whether the word is true of a claim of more where ``truth`` is the difference."""
    return {"supported": truth > 0, "refuted": truth < 0, "too small to matter": abs(truth) < LEAST}.get(word, True)


def _claim(kind: Kind, effect: float, rng: np.random.Generator) -> tuple[Verdict, float]:
    """The verdict on one claim, and the true mean difference of its scenes."""
    rows, effects, shift = kind.draw(rng)
    pairs = Pairs(
        tuple(scene_pairs(k, row, effect + own) for k, (row, own) in enumerate(zip(rows, effects, strict=True)))
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
        (SimpleNamespace(path=Path(f"{place}/a{k}")), SimpleNamespace(path=Path(f"{place}/b{k}"))) for k in range(count)
    )
    return ScenePairs(str(place), tuple(range(count)), trials, noise[0], noise[1] + effect)


QUANTITY = asked_quantity("psnr")
PAGE = Path(__file__).parents[1] / "docs" / "verdict.md"
SECTION = re.compile(r"(<!-- untruths -->\n).*?(<!-- end -->)", re.DOTALL)
EFFECTS = (0.0, 0.5, 1.0, 2.0)


def table(checks: int) -> str:
    """A kind of sweep and a real effect a row: what is said of a claim, and in how many checks a word is untrue."""
    lines = ["| differences | effect | supported | refuted | too small | undecided | untrue: supported | refuted | "]
    lines[0] += "too small | scenes like these |"
    lines.append("|" + "---|" * 10)
    for name, kind in KINDS.items():
        for effect in EFFECTS:
            found = rates(kind, effect, checks)
            shares = [*found.told.values(), *found.untrue.values(), found.like_these]
            lines.append(f"| {name} | {effect:g} | " + " | ".join(f"{100 * share:.1f} %" for share in shares) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checks", type=int, help="print the table of so many checks a row, and leave the page alone")
    wanted = parser.parse_args().checks
    made = table(wanted or 3000)
    if wanted is None:
        PAGE.write_text(SECTION.sub(lambda m: m[1] + made + m[2], PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    else:
        print(made, end="")
