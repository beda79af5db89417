"""Rounds of votes in words, and the views where people and LPIPS disagree."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from gsbench.analysis.images import ViewComparison, compare_view
from gsbench.analysis.quantities import Quantity, choose_quantities
from gsbench.analysis.results import TrialResult
from gsbench.analysis.statistics import EXACT_FOR_PEOPLE, UNDECIDED, LikeThese
from gsbench.analysis.table_formats import Column, Row, Table, TableEntry
from gsbench.analysis.verdict_words import WORDS, p_text
from gsbench.analysis.verdicts import PairVerdicts
from gsbench.analysis.votes import PairVotes, RoundVerdict, judge_round, view_gains
from gsbench.errors import InputError
from gsbench.eval.facts import LPIPS
from gsbench.files import require_no_links
from gsbench.runs.layout import VOTES
from gsbench.runs.votes import read_ballots, read_key
from gsbench.words import counted, signed

MAX_SHOWN = 3  # views where people and LPIPS disagree that the report shows

log = logging.getLogger(__name__)


def load_rounds(home: Path) -> list[RoundVerdict]:
    """The verdicts of all rounds in ``home``, oldest first; a damaged round gives a warning."""
    verdicts = []
    for folder in (home / VOTES).glob("*/"):
        try:
            require_no_links(home.parent, folder, below=True)
            key = read_key(folder)
            ballots, faults = read_ballots(folder, key)
            verdict = judge_round(key, list(ballots.values()))
            verdicts.append(replace(verdict, left_out=faults | dict(verdict.left_out)))
        except InputError as error:
            log.warning("left out: %s", error)
    return sorted(verdicts, key=lambda one: one.key.time)


def people_words(count: int) -> str:
    """``1 person``, ``9 people``"""
    return f"{count} {'person' if count == 1 else 'people'}"


def describe_round(verdict: RoundVerdict) -> list[str]:
    """A round's lines: how many voted, verdicts on arms, ranking, and who was left out."""
    key = verdict.key
    when = f"{key.time[:16].replace('T', ' ')} UTC"
    voted = f"{counted(verdict.votes, 'vote')} of {people_words(len(verdict.counted))}"
    lines = [f"Round {key.round}: {voted}; {key.votes} were declared ({when})."]
    if not verdict.final:
        lines.append(f"This is an early look: nothing is decided before {key.votes} votes.")
    for pair in verdict.pairs:
        lines += _describe_pair(pair, verdict.final)
    if verdict.ranking:
        ranks = [
            f"{arm} {100 * chance:.0f} % ({100 * interval.low:.0f} to {100 * interval.high:.0f})"
            for arm, chance, interval in verdict.ranking
        ]
        lines.append(
            f"Chance to win against the average arm, with 95 % intervals: {'; '.join(ranks)}."
        )
    if verdict.counted:
        lines.append(
            f"{100 * verdict.consistent:.0f} % of the pairs shown again, swapped, had the same "
            f"answer; {100 * verdict.left:.0f} % of the votes were for the left side."
        )
    return lines + [f"Left out: {person} {reason}." for person, reason in verdict.left_out.items()]


def _describe_pair(pair: PairVotes, final: bool) -> list[str]:
    """The votes on an arm against the baseline, and what they say of people and of scenes."""
    parts = ""
    for how in ("most different", "random"):
        means = [mean for showing, mean in pair.views if showing.chosen == how]
        parts += f", {50 + 50 * sum(means) / len(means):.0f} % of the {how} views" if means else ""
    return [
        f"{pair.arm} against {pair.baseline}: {_share(pair)} ({pair.wins} for it, {pair.losses} "
        f"against it, {pair.ties} without a difference{parts}).",
        f"People like these, on these views: {_statement(pair.people, 'people', final)}; exact "
        f"for: {EXACT_FOR_PEOPLE}.",
        f"Scenes like these, for these people: {_statement(pair.scenes, 'scenes', final)}.",
    ]


def _statement(like: LikeThese | None, units: str, final: bool) -> str:
    """``better; for it are 8 of 9 people (sign test at 5 %, p 0.039; median share 55 to 83 %)``"""
    if like is None:
        return f"{UNDECIDED}, since the sign test needs six {units}"
    median = ""
    if like.median is not None:
        median = (
            f"; median share {50 + 50 * like.median.low:.0f} to {50 + 50 * like.median.high:.0f} %"
        )
    votes = f"for it are {like.helped} of {like.scenes} {units}"
    test = f"sign test at {100 * like.level:.3g} %, p {p_text(like.p)}"
    return f"{_word(like, final)}; {votes} ({test}{median})"


def _word(like: LikeThese | None, final: bool) -> str:
    return UNDECIDED if like is None or not final else WORDS[like.outcome]


def _share(pair: PairVotes) -> str:
    return f"{100 * pair.share:.0f} % of {pair.wins + pair.losses + pair.ties} votes"


def vote_table(
    pair: PairVotes, final: bool, trials: Sequence[TrialResult], judged: Sequence[PairVerdicts]
) -> Table:
    """People's verdict beside those of metrics, and how often a metric prefers as people do."""
    rows = [
        Row(
            (f"{units} like these",),
            (TableEntry(_word(like, final)), TableEntry(_share(pair)), TableEntry("")),
        )
        for units, like in (("people", pair.people), ("scenes", pair.scenes))
    ]
    own = [
        answer for answer in judged if (answer.first, answer.second) == (pair.baseline, pair.arm)
    ]
    verdicts = {verdict.question.metric: verdict for answer in own for verdict in answer.verdicts}
    gains = view_gains(trials, pair)
    for metric in _metrics(pair, trials):
        both = zip(pair.views, gains, strict=True)
        signs = [
            mean * metric.direction * gain[metric.key]
            for (_, mean), gain in both
            if gain.get(metric.key)
        ]
        one = verdicts.get(metric.key)
        word, difference = (
            ("not compared", "")
            if one is None
            else (WORDS[one.outcome], one.shown(one.mean or 0.0))
        )
        agreed = f"{sum(sign > 0 for sign in signs)} of {sum(sign != 0 for sign in signs)} views"
        rows.append(Row((metric.heading,), tuple(map(TableEntry, (word, difference, agreed)))))
    heads = ("verdict", "share of votes, or difference", "prefers what people prefer")
    title = f"People and metrics: {pair.arm} against {pair.baseline}"
    return Table(
        title,
        ("judged by",),
        tuple(Column("", head, ("votes", head)) for head in heads),
        tuple(rows),
    )


def _metrics(pair: PairVotes, trials: Sequence[TrialResult]) -> list[Quantity]:
    """The metrics of the two arms that have a direction, LPIPS first."""
    own = [trial for trial in trials if trial.arm in (pair.arm, pair.baseline)]
    metrics = [metric for metric in choose_quantities(own) if metric.direction and not metric.cost]
    return sorted(metrics, key=lambda one: not one.key.startswith(LPIPS))


def disagreements(pair: PairVotes, trials: Sequence[TrialResult]) -> list[ViewComparison]:
    """Pictures of `MAX_SHOWN` views or fewer where people and LPIPS disagree, clearest first.

    LPIPS is the first variant that both trials of the view have.
    """
    lpips = [metric for metric in _metrics(pair, trials) if metric.key.startswith(LPIPS)]
    by_trial = {(trial.arm, trial.scene, trial.seed): trial for trial in trials}
    shown = list[ViewComparison]()
    for (one, mean), gains in sorted(
        zip(pair.views, view_gains(trials, pair), strict=True), key=lambda both: -abs(both[0][1])
    ):
        metric = next((metric for metric in lpips if metric.key in gains), None)
        if (
            metric is None
            or mean * metric.direction * gains[metric.key] >= 0
            or len(shown) == MAX_SHOWN
        ):
            continue
        people, other = (pair.arm, pair.baseline) if mean > 0 else (pair.baseline, pair.arm)
        words = (
            f"people prefer {people} (mean vote {signed(mean, '.2f')}), {metric.name} prefers "
            f"{other}"
        )
        trials_shown = (
            by_trial[pair.baseline, one.scene, one.seed],
            by_trial[pair.arm, one.scene, one.seed],
        )
        shown.append(compare_view(words, trials_shown, one.view))
    return shown
