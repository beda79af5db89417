"""People's votes on which of two renders is nearer to the photograph, and what they show.

`gsbench.claims.vote_page` makes a round: pairs of renders (each with the photograph), some of them
a second time with the sides swapped, and traps, which show the photograph beside a blurred one.
Everybody sees the same showings.

A vote is independent neither of the other votes of its person nor of those of its scene. So a
person's mean preference is one unit, and so is a scene's.
`gsbench.analysis.statistics.judge_like_these`, an exact sign test, judges both: people like these
on the shown views, and scenes like these for the people who voted. Each needs six units.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gsbench.analysis.results import TrialResult, read_views
from gsbench.analysis.statistics import ALPHA, Interval, LikeThese, judge_like_these
from gsbench.errors import InputError
from gsbench.runs.experiments import Arm
from gsbench.runs.votes import PHOTOGRAPH, SAME, Ballot, RoundKey, Showing
from gsbench.scene.images import png_name

METRIC = "votes"  # of the declared question
# Preferences from -1 to 1 within ± this are too small to matter: between 45 and 55 % of the votes.
LEAST_PREFERENCE = 0.1
DRAWS = 2000  # of people and scenes, for the intervals of a ranking
STEPS = 200  # of the iteration that ranks arms; it converges in some dozens

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PairVotes:
    """The votes on ``arm`` against ``baseline`` with two statements, None below six units.

    ``views`` have the mean vote on each view, from -1 (all for the baseline) to 1.
    """

    baseline: Arm
    arm: Arm
    wins: int
    losses: int
    ties: int
    people: LikeThese | None
    scenes: LikeThese | None
    views: tuple[tuple[Showing, float], ...]

    @property
    def share(self) -> float:
        """The share of votes for the arm; "no difference" counts half for each."""
        return (self.wins + self.ties / 2) / (self.wins + self.losses + self.ties)


@dataclass(frozen=True)
class RoundVerdict:
    """The result of a round.

    ``left_out`` says by person why their votes do not count. ``final`` is False below the
    declared number of votes: then nothing is decided yet. ``consistent`` is the share of the
    pairs shown again that had the same answer, ``left`` that of votes for the left side; NaN
    without any. ``ranking`` is filled if the round has more than two arms: each arm with its
    chance to win against the average arm, the best first.
    """

    key: RoundKey
    counted: tuple[Ballot, ...]
    left_out: Mapping[str, str]
    pairs: tuple[PairVotes, ...]
    ranking: tuple[tuple[Arm, float, Interval], ...]
    consistent: float
    left: float

    @property
    def votes(self) -> int:
        return len(self.counted) * len(self.key.pairs)

    @property
    def final(self) -> bool:
        return self.votes >= self.key.votes


def judge_round(key: RoundKey, ballots: Sequence[Ballot]) -> RoundVerdict:
    """A round's verdict: traps first, then at most the declared people in the given order.

    The order is that in which ballots were handed in, so later ones never take another's place.
    """
    left_out: dict[str, str] = {}
    counted = list[Ballot]()
    traps = [showing for showing in key.showings if showing.kind == "trap"]
    for ballot in ballots:
        wrong = sum(_preference(trap, ballot, PHOTOGRAPH) != 1 for trap in traps)
        if wrong > key.traps_allowed:
            left_out[ballot.label] = (
                f"failed {wrong} of {len(traps)} traps, and {key.traps_allowed} may fail"
            )
        elif len(counted) == key.people:
            # Adding people until the result pleases would find effects that do not exist.
            left_out[ballot.label] = (
                f"came after the {key.people} people whose votes were declared to count"
            )
        else:
            counted.append(ballot)
    pairs = [_judge_pair(key, counted, arm) for arm in key.arms[1:] if counted]
    first = {showing.id: showing for showing in key.showings}
    seen = [
        (showing, ballot)
        for showing in key.showings
        for ballot in counted
        if showing.kind != "trap"
    ]
    again = [
        _preference(one, ballot, one.left) == _preference(first[one.of], ballot, one.left)
        for one, ballot in seen
        if one.kind == "again"
    ]
    sides = [
        ballot.answers[one.id] == "left" for one, ballot in seen if ballot.answers[one.id] != SAME
    ]
    return RoundVerdict(
        key,
        tuple(counted),
        left_out,
        tuple(pair for pair in pairs if pair is not None),
        rank_arms(key, counted) if counted and len(key.arms) > 2 else (),
        sum(again) / len(again) if again else math.nan,
        sum(sides) / len(sides) if sides else math.nan,
    )


def _preference(showing: Showing, ballot: Ballot, side: str) -> int:
    """1 if the ballot prefers ``side`` (an arm, or a trap's photograph), -1 the other, else 0."""
    answer = ballot.answers[showing.id]
    if answer == SAME:
        return 0
    return 1 if getattr(showing, answer) == side else -1


def _judge_pair(key: RoundKey, counted: Sequence[Ballot], arm: Arm) -> PairVotes | None:
    """The verdict on ``arm`` against the baseline; None if the round shows no view of the two."""
    sides = {str(arm), str(key.arms[0])}
    showings = [pair for pair in key.pairs if {pair.left, pair.right} == sides]
    if not showings:
        return None
    votes = np.array(
        [[_preference(showing, ballot, str(arm)) for showing in showings] for ballot in counted]
    )
    statements = judge_votes(
        votes, [showing.scene for showing in showings], ALPHA / (len(key.arms) - 1)
    )
    wins, losses, ties = (int((votes == side).sum()) for side in (1, -1, 0))
    means = zip(showings, map(float, votes.mean(axis=0)), strict=True)
    return PairVotes(key.arms[0], arm, wins, losses, ties, *statements, tuple(means))


def judge_votes(
    votes: NDArray[np.int_], scenes: Sequence[str], level: float
) -> tuple[LikeThese | None, LikeThese | None]:
    """The statements about people like these and scenes like these, each None below six units.

    ``votes`` [K, V] of K people on V views are 1, 0 or -1; ``scenes`` has the scene of each view.
    """
    places = np.array(scenes)  # [V]
    own = [votes[:, places == scene] for scene in dict.fromkeys(scenes)]
    cells = np.stack([one.mean(axis=1) for one in own])  # [S, K]: scenes have the same weight
    people, views = cells.mean(axis=0), cells.mean(axis=1)
    return judge_like_these(people, 1, LEAST_PREFERENCE, level), judge_like_these(
        views, 1, LEAST_PREFERENCE, level
    )


def rank_arms(key: RoundKey, counted: Sequence[Ballot]) -> tuple[tuple[Arm, float, Interval], ...]:
    """The arms by their chance to win against the average arm, the best first."""
    names = [str(arm) for arm in key.arms]
    scenes = list(dict.fromkeys(pair.scene for pair in key.pairs))
    people, arms = len(counted), len(names)
    wins = np.zeros((people, len(scenes), arms, arms))  # [K, S, A, A], of row against column
    for person, ballot in enumerate(counted):
        for one in key.pairs:
            left, right = names.index(one.left), names.index(one.right)
            for_left = (1 + _preference(one, ballot, one.left)) / 2
            wins[person, scenes.index(one.scene), left, right] += for_left
            wins[person, scenes.index(one.scene), right, left] += 1 - for_left
    ranked = [
        (arm, float(chance), Interval(float(low), float(high)))
        for arm, chance, low, high in zip(key.arms, *rank_wins(wins), strict=True)
    ]
    return tuple(sorted(ranked, key=lambda one: -one[1]))


def rank_wins(wins: Array) -> tuple[Array, Array, Array]:
    """The `bradley_terry` chances [A] with ends of 95 % intervals, of ``wins`` [K, S, A, A].

    The standard errors of the log-odds come from drawing people and scenes anew, both with
    replacement (Owen 2007, Ann. Appl. Stat. 1, 386). Percentiles of so few units would be too
    narrow, so Student's t widens them, with one degree of freedom less than there are people or
    scenes, whichever are fewer. One person and one scene have no interval.
    """
    rng = np.random.default_rng(0)
    units = [count for count in wins.shape[:2] if count > 1]
    people, scenes = (
        rng.multinomial(count, np.full(count, 1 / count), DRAWS).astype(float)
        for count in wins.shape[:2]
    )
    drawn = bradley_terry(np.einsum("dk,ds,ksij->dij", people, scenes, wins, optimize=True))
    error = special.logit(drawn).std(axis=0, ddof=1)
    half = (
        special.stdtrit(min(units) - 1, 1 - ALPHA / 2) * error
        if units
        else np.full(wins.shape[-1], np.inf)
    )
    chances = bradley_terry(wins.sum(axis=(0, 1))[None])[0]
    middle = special.logit(chances)
    return chances, special.expit(middle - half), special.expit(middle + half)


def bradley_terry(wins: Array) -> Array:
    """The chance [D, A] of each arm to win against the average one, by ``wins`` [D, A, A].

    The model is that of Bradley and Terry (1952), fitted by the iteration of Hunter (2004, Ann.
    Stat. 32, 384). Half a vote more for each arm against each other keeps an arm that never lost at
    a finite strength.
    """
    arms = wins.shape[-1]
    wins = wins + 0.5 * (1 - np.eye(arms))
    games = wins + wins.swapaxes(1, 2)
    strengths = np.ones(wins.shape[:2])
    for _ in range(STEPS):
        sums = strengths[:, :, None] + strengths[:, None, :]  # [D, A, A]
        strengths = wins.sum(axis=2) / (games / sums).sum(axis=2)
        strengths /= np.exp(np.log(strengths).mean(axis=1, keepdims=True))
    return np.asarray(strengths / (1 + strengths))


# ---- beside the metrics


def view_gains(trials: Sequence[TrialResult], pair: PairVotes) -> list[dict[str, float]]:
    """The difference of every metric, arm minus baseline, for each view of ``pair.views``.

    A view has none if a trial or its file of views is gone or damaged.
    """
    files: dict[tuple[Arm, str, int], dict[str, dict[str, float]]] = {}
    for trial in trials:
        if trial.arm in (pair.arm, pair.baseline):
            with suppress(InputError):
                views = {png_name(name): values for name, values in read_views(trial).items()}
                files[trial.arm, trial.scene, trial.seed] = views
    gains = []
    for one, _ in pair.views:
        arm, baseline = (
            files.get((side, one.scene, one.seed), {}).get(f"{one.view}.png", {})
            for side in (pair.arm, pair.baseline)
        )
        gains.append({key: arm[key] - baseline[key] for key in arm.keys() & baseline.keys()})
    return gains
