"""Rounds of votes in words, for the terminal and the report, with the views where people and LPIPS disagree."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsbench.analysis.images import ViewComparison, compare_view
from gsbench.analysis.quantities import Quantity, choose_quantities
from gsbench.analysis.results import TrialResult
from gsbench.analysis.statistics import UNDECIDED, LikeThese
from gsbench.analysis.table_formats import Column, Row, Table, TableEntry
from gsbench.analysis.verdicts import WORDS, PairVerdicts, p_text
from gsbench.analysis.votes import (
    PairVotes,
    RoundKey,
    RoundVerdict,
    ViewVotes,
    agreement,
    judge_round,
    read_ballot,
    read_key,
    view_gains,
)
from gsbench.errors import InputError
from gsbench.eval.facts import LPIPS
from gsbench.files import require_no_links
from gsbench.runs.experiments import Arm
from gsbench.runs.layout import VOTE_KEY, VOTES
from gsbench.words import counted, signed

MAX_SHOWN = 3  # views where people and LPIPS disagree that the report shows with pictures

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Disagreement:
    """A view where people and LPIPS prefer different arms: the sentence about it, and pictures of the first few."""

    words: str
    first: str  # the arms of the pictures
    second: str
    pictures: ViewComparison | None


def load_rounds(home: Path) -> list[RoundVerdict]:
    """The verdicts of all rounds of the experiment in ``home``, the oldest first; a damaged round gives a warning."""
    verdicts = []
    for folder in sorted((home / VOTES).glob("*/")):
        try:
            require_no_links(home.parent, folder, below=True)
            key = read_key(folder)
            ballots = [read_ballot(file) for file in sorted(folder.glob("*.json")) if file.name != VOTE_KEY]
            verdicts.append(judge_round(key, ballots))
        except InputError as error:
            log.warning("left out: %s", error)
    return sorted(verdicts, key=lambda one: one.key.time)


def describe_round(verdict: RoundVerdict, trials: Sequence[TrialResult]) -> list[str]:
    """The lines of a round: how many voted, the verdict on each arm, its agreement with metrics, and the ranking."""
    key = verdict.key
    people = people_words(len(verdict.counted))
    lines = [
        f"Round {key.round}: {counted(verdict.votes, 'vote')} of {people}; {key.votes} were declared ({key.time})."
    ]
    if not verdict.final:
        lines.append(f"This is an early look: nothing is decided before {key.votes} votes.")
    for pair in verdict.pairs:
        lines += describe_pair(pair, verdict.final)
        lines += [agreement_words(pair, trials)]
    if verdict.ranking:
        ranks = [
            f"{one.arm} {100 * one.chance:.0f} % ({100 * one.interval.low:.0f} to {100 * one.interval.high:.0f})"
            for one in verdict.ranking
        ]
        lines.append(
            f"Chance to win against the average arm (Bradley and Terry), with 95 % intervals: {'; '.join(ranks)}."
        )
    if verdict.consistent is not None and verdict.left is not None:
        lines.append(
            f"{100 * verdict.consistent:.0f} % of the pairs shown again, swapped, had the same answer; "
            f"{100 * verdict.left:.0f} % of the votes were for the left side."
        )
    return lines + [f"Left out: {person} {reason}." for person, reason in verdict.left_out.items()]


def _when(key: RoundKey) -> str:
    return f"{key.time[:16].replace('T', ' ')} UTC"


def summary(verdict: RoundVerdict) -> list[str]:
    """A sentence on each arm, for the top of the report."""
    return [
        f"{pair.arm} against {pair.baseline}: {_share(pair)} of {people_words(len(verdict.counted))} are for it; "
        f"people like these {_word(pair.people, verdict.final)}, scenes like these {_word(pair.scenes, verdict.final)}"
        for pair in verdict.pairs
    ]


def people_words(count: int) -> str:
    """``1 person``, ``9 people``"""
    return f"{count} {'person' if count == 1 else 'people'}"


def describe_pair(pair: PairVotes, final: bool) -> list[str]:
    """The votes on an arm against the baseline, and the statements about people and about scenes."""
    by_choice = {how: share for how in ("most different", "random") if (share := pair.share_of(how)) is not None}
    parts = ", ".join(f"{100 * share:.0f} % of the {how} views" for how, share in by_choice.items())
    return [
        f"{pair.arm} against {pair.baseline}: {100 * pair.share:.0f} % of the votes ({pair.wins} for it, {pair.losses} "
        f"against it, {pair.ties} without a difference; {parts}).",
        f"People like these, on these views: {_statement(pair.people, 'people', final)}.",
        f"Scenes like these, for these people: {_statement(pair.scenes, 'scenes', final)}.",
    ]


def _statement(like: LikeThese | None, units: str, final: bool) -> str:
    """``supported; 8 of 9 people prefer it (sign test p 0.039; their median share 55 to 83 %)``"""
    if like is None:
        return f"{UNDECIDED}, since the sign test needs six {units}"
    word = like.outcome if final else UNDECIDED
    median = ""
    if like.median is not None:
        low, high = (50 * (1 + end) for end in (like.median.low, like.median.high))
        median = f"; their median share {low:.0f} to {high:.0f} %"
    prefer = "prefer it" if units == "people" else "are better by it"
    return f"{word}; {like.helped} of {like.scenes} {units} {prefer} (sign test p {p_text(like.p)}{median})"


def agreements(pair: PairVotes, trials: Sequence[TrialResult]) -> list[tuple[Quantity, int, int]]:
    """Each metric with the views in which it prefers the arm that people prefer, of those in which both prefer one."""
    gains = view_gains(trials, pair)
    found = []
    for metric in _metrics(pair, trials):
        both = [
            (one.preference, own[metric.key]) for one, own in zip(pair.views, gains, strict=True) if metric.key in own
        ]
        same, views = agreement([one for one, _ in both], [metric.direction * gain for _, gain in both])
        found += [(metric, same, views)] if views else []
    return found


def agreement_words(pair: PairVotes, trials: Sequence[TrialResult]) -> str:
    """The number of views in which each metric prefers the arm that people prefer, as a sentence."""
    parts = [f"{metric.name} in {same} of {views}" for metric, same, views in agreements(pair, trials)]
    if not parts:
        return "No metric prefers an arm on these views."
    return f"Views in which a metric prefers the arm that people prefer: {', '.join(parts)}."


def vote_table(pair: PairVotes, final: bool, trials: Sequence[TrialResult], judged: Sequence[PairVerdicts]) -> Table:
    """People's verdict beside that of each metric on the same arms; LPIPS comes first."""
    rows = [
        Row((f"{units} like these",), (TableEntry(_word(like, final)), TableEntry(_share(pair)), TableEntry("")))
        for units, like in (("people", pair.people), ("scenes", pair.scenes))
    ]
    arms = (pair.baseline, pair.arm)
    verdicts = {one.question.metric: one for own in judged if (own.first, own.second) == arms for one in own.verdicts}
    by_metric = agreements(pair, trials)
    for metric, same, views in sorted(by_metric, key=lambda one: not one[0].key.startswith(LPIPS)):
        one = verdicts.get(metric.key)
        word, difference = ("not compared", "") if one is None else (WORDS[one.outcome], one.shown(one.mean or 0.0))
        rows.append(Row((metric.heading,), tuple(map(TableEntry, (word, difference, f"{same} of {views} views")))))
    heads = ("verdict", "share of votes, or difference", "prefers what people prefer")
    title = f"People and metrics: {pair.arm} against {pair.baseline}"
    return Table(title, ("judged by",), tuple(Column("", head, ("votes", head)) for head in heads), tuple(rows))


def _word(like: LikeThese | None, final: bool) -> str:
    return WORDS["undecided" if like is None or not final else like.outcome]


def _share(pair: PairVotes) -> str:
    return f"{100 * pair.share:.0f} % of {pair.wins + pair.losses + pair.ties} votes"


def disagreements(pair: PairVotes, trials: Sequence[TrialResult]) -> list[Disagreement]:
    """The views where people and LPIPS prefer different arms, those with the clearest votes first."""
    gains = view_gains(trials, pair)
    lpips = [
        one for one in _metrics(pair, trials) if one.key.startswith(LPIPS) and any(one.key in own for own in gains)
    ]
    found: list[tuple[ViewVotes, float]] = []
    for view, own in zip(pair.views, gains, strict=True):
        gain = -own.get(lpips[0].key, 0.0) if lpips else 0.0
        if view.preference * gain < 0:
            found.append((view, gain))
    found.sort(key=lambda both: -abs(both[0].preference))
    return [
        Disagreement(
            f"{view.showing.scene}, view {view.showing.view}, seed {view.showing.seed} ({view.showing.chosen}): people "
            f"prefer {_preferred(pair, view.preference)} (mean vote {signed(view.preference, '.2f')}), {lpips[0].name} "
            f"prefers {_preferred(pair, gain)} (by {abs(gain):.4f})",
            str(pair.baseline),
            str(pair.arm),
            pictures_of(pair, view, trials) if place < MAX_SHOWN else None,
        )
        for place, (view, gain) in enumerate(found)
    ]


def pictures_of(pair: PairVotes, view: ViewVotes, trials: Sequence[TrialResult]) -> ViewComparison | None:
    """The pictures of a view; None if they cannot be read any more."""
    one = view.showing
    by_arm = {trial.arm: trial for trial in trials if (trial.scene, trial.seed) == (one.scene, one.seed)}
    try:
        return compare_view("", (by_arm[pair.baseline], by_arm[pair.arm]), one.view)
    except (KeyError, InputError):
        return None


def _preferred(pair: PairVotes, gain: float) -> Arm:
    return pair.arm if gain > 0 else pair.baseline


def _metrics(pair: PairVotes, trials: Sequence[TrialResult]) -> list[Quantity]:
    """The metrics with a known direction; the LPIPS of the protocol comes before other variants."""
    own = [trial for trial in trials if trial.arm in (pair.arm, pair.baseline)]
    return [metric for metric in choose_quantities(own) if metric.direction and not metric.cost]
