"""Simulate rounds of votes whose truth is known, for findings/simulations.md.

    python scripts/vote_untruths.py                  write the tables into the page (three minutes)
    python scripts/vote_untruths.py --rounds 200     print it from fewer rounds

The tables say how often a verdict is wrong. The log-odds of a vote for the arm are the sum of a
real effect and of a person's, a scene's and a view's own; a fifth of the votes say "no difference".
A statement about people is about these views: it is wrong unless it has the sign that the median
person has on them. A statement about scenes is about these people, in the same way.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
import simulations
from numpy.typing import NDArray
from scipy.special import bdtr

from gsbench.analysis.statistics import UNDECIDED, LikeThese
from gsbench.analysis.votes import bradley_terry, judge_votes, rank_wins

PAIRS, LEVEL, SAME = 45, 0.05, 0.2
VIEW = 0.5  # deviation of views in a scene


@dataclass(frozen=True)
class Kind:
    """A kind of round: deviations of people and of scenes (log-odds), and how many there are."""

    people_differ: float = 0.0
    scenes_differ: float = 0.0
    people: int = 9
    scenes: int = 9
    views_differ: float = VIEW


KINDS = {
    "everybody guesses": Kind(views_differ=0.0),
    "people differ": Kind(people_differ=2.0),
    "scenes differ": Kind(scenes_differ=2.0),
    "people and scenes differ": Kind(people_differ=1.0, scenes_differ=1.0),
    "people and scenes differ, 20 people": Kind(people_differ=1.0, scenes_differ=1.0, people=20),
    "people and scenes differ, 3 scenes": Kind(people_differ=1.0, scenes_differ=1.0, scenes=3),
    "people and scenes differ, 3 people": Kind(people_differ=1.0, scenes_differ=1.0, people=3),
}
EFFECTS = (0.0, 1.0)


def rates(kind: Kind, effect: float, rounds: int, seed: int = 0) -> list[float]:
    """The shares of rounds in which a statement is decided, and in which it is decided wrongly.

    The two shares are for each of four statements: about people, about scenes, about both, and from
    all votes. "Both" needs the same outcome for people and scenes, and is about people and scenes
    like these. "All votes" is a binomial test that takes every vote as independent.
    """
    rng = np.random.default_rng([seed, round(1000 * effect)])
    counts = np.zeros(8)
    scene_of = np.arange(PAIRS) % kind.scenes
    for _ in range(rounds):
        people = rng.normal(0, kind.people_differ, kind.people)
        scenes = rng.normal(0, kind.scenes_differ, kind.scenes)
        views = scenes[scene_of] + rng.normal(0, kind.views_differ, PAIRS)
        chance = 1 / (1 + np.exp(-(effect + people[:, None] + views)))
        votes = np.where(rng.random(chance.shape) < chance, 1, -1) * (
            rng.random(chance.shape) >= SAME
        )
        of_views = [np.tanh((effect + views[scene_of == k]) / 2).mean() for k in range(kind.scenes)]
        truths = (float(np.mean(of_views)), float(np.tanh((effect + people) / 2).mean()))
        stated = [sign_of(like) for like in judge_votes(votes, list(map(str, scene_of)), LEVEL)]
        both = stated[0] if stated[0] == stated[1] else 0
        for place, (sign, truth) in enumerate(
            zip([*stated, both, naive(votes)], [*truths, effect, effect], strict=True)
        ):
            counts[2 * place] += sign != 0
            counts[2 * place + 1] += sign != 0 and sign != np.sign(round(truth, 9))
    return list(counts / rounds)


def sign_of(like: LikeThese | None) -> int:
    if like is None or like.outcome == UNDECIDED:
        return 0
    return {"supported": 1, "refuted": -1}.get(like.outcome, 0)


def naive(votes: NDArray[np.int_]) -> int:
    """The sign that a binomial test of all votes states at 5 %, 0 for none."""
    wins, losses = int((votes > 0).sum()), int((votes < 0).sum())
    p = 2 * float(bdtr(min(wins, losses), wins + losses, 0.5))
    return int(np.sign(wins - losses)) if p < LEVEL else 0


def ranking_misses(people: int, scenes: int, rounds: int) -> float:
    """The share of intervals of a ranking that miss the arm's chance over all people and scenes.

    The strengths of the three arms are 0, 0.5 and 1 (log-odds); each person and each scene has its
    own, with a deviation of 0.7. Three views of each scene show each pair of arms.
    """
    rng = np.random.default_rng([people, scenes])
    real, deviation, views = np.array([0.0, 0.5, 1.0]), 0.7, 3

    def chances(
        of_people: NDArray[np.float64], of_scenes: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        own = real + of_people[:, None] + of_scenes[None]  # [K, S, A]
        return 1 / (1 + np.exp(own[:, :, None, :] - own[:, :, :, None]))

    many = chances(rng.normal(0, deviation, (1000, 3)), rng.normal(0, deviation, (1000, 3)))
    truth = bradley_terry(1e4 * many.mean(axis=(0, 1))[None] * (1 - np.eye(3)))[0]
    missed = 0
    for _ in range(rounds):
        chance = chances(
            rng.normal(0, deviation, (people, 3)), rng.normal(0, deviation, (scenes, 3))
        )
        wins = np.triu(rng.binomial(views, chance), 1).astype(float)
        wins += np.tril(views - wins.swapaxes(2, 3), -1)
        _, low, high = rank_wins(wins)
        missed += int(((truth < low) | (truth > high)).sum())
    return missed / rounds / 3


def table(rounds: int) -> str:
    """The table: how often each statement decides, and how often wrongly, by kind and effect."""
    lines = [
        "| votes | effect | people decide | wrong | scenes decide | wrong | both | wrong | all "
        "votes as one | wrong |"
    ]
    lines.append("|" + "---|" * 10)
    for name, kind in KINDS.items():
        for effect in EFFECTS:
            shares = " | ".join(f"{100 * share:.1f} %" for share in rates(kind, effect, rounds))
            lines.append(f"| {name} | {effect:g} | {shares} |")
    lines += ["", "| intervals of a ranking of three arms | miss |", "|---|---|"]
    for people, scenes in ((9, 9), (20, 9), (9, 3), (3, 3)):
        lines.append(
            f"| {people} people, {scenes} scenes | "
            f"{100 * ranking_misses(people, scenes, rounds // 10):.1f} % |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--rounds", type=int, help="print the table from this many rounds a row; the page stays"
    )
    wanted = parser.parse_args().rounds
    made = table(wanted or 3000)
    if wanted is None:
        simulations.write_table("votes", made)
    else:
        print(made, end="")
