"""The verdict on a question. `judge` is the only code that decides one.

It needs the question and its trials and nothing else: no folder, no clock, no other question. It
serves tables, reports, looks, gates and ledgers.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from statistics import median_low
from typing import Literal

import numpy as np

from gsbench.analysis.differences import between_scenes_notes
from gsbench.analysis.notes import Note
from gsbench.analysis.pairs import SAME_CAPTURE, Pairs, are_equal, pair
from gsbench.analysis.quantities import Quantity, asked_quantity
from gsbench.analysis.questions import look_shares
from gsbench.analysis.results import TrialResult, Unfinished, trials_of
from gsbench.analysis.statistics import (
    ALPHA,
    Interval,
    LikeThese,
    Outcome,
    StudentT,
    favoured,
    judge_like_these,
    outcome_of,
    t_test,
)
from gsbench.runs.commands import Question
from gsbench.runs.experiments import Arm
from gsbench.words import signed

# deviations from the other trials of its scene and arm, beyond which a trial is outlying
OUTLYING = 5.0
LEAST_OTHERS = 2  # the fewest other trials that this needs
# corrects the median sample deviation of three trials, which is too small: 1 / sqrt(ln 2)
FEW = 1.2

# The chance, at each look, that an idea of a ledger that is as good as the least difference that
# matters is given up. It costs power and cannot make a false discovery.
GIVE_UP = 0.05

State = Literal["answered", "running", "stopped", "not tested", "not asked beforehand"]


# a scene's mean paired difference, its seeds, and its 95 % interval, which is not tested; without
# an interval if one arm lacks results, or with a single pair
SceneRow = tuple[str, float, int, Interval | None]


@dataclass(frozen=True)
class Verdict:
    """The answer to a question from ``pairs`` of trials.

    Only in the ``state`` "answered" the ``outcome`` says more than "undecided". ``test`` is about
    these scenes, None with a single pair of each; ``like_these`` is about scenes like these. Both
    have the ``level``. ``done`` of the question's trials have a result or have failed.
    ``untestable`` says why such trials can never answer it. ``final`` is False while trials to come
    may decide. ``lacking`` are trials of one arm without a result where the other arm has one; if
    the outcome favoured that arm, the verdict ``favours_lacking`` and is undecided. ``outlying``
    trials lie far outside the others of their scene and arm; they change nothing.
    """

    question: Question
    quantity: Quantity
    pairs: Pairs
    state: State
    level: float
    outcome: Outcome = "undecided"
    test: StudentT | None = None
    like_these: LikeThese | None = None
    done: int = 0
    final: bool = True
    untestable: Note | None = None
    outlying: tuple[TrialResult, ...] = ()
    missing: tuple[Unfinished, ...] = ()  # planned trials that are not there yet
    lacking: tuple[Unfinished, ...] = ()
    favours_lacking: bool = False

    @property
    def is_tested(self) -> bool:
        """Return whether it is, or will be, more than a mean and an interval."""
        return self.state not in ("not tested", "not asked beforehand")

    @property
    def is_open(self) -> bool:
        """Return whether it waits for trials of its question."""
        return self.state in ("running", "stopped")

    @cached_property
    def scenes(self) -> list[SceneRow]:
        """The estimates of single scenes."""
        lacking = {one.scene for one in self.lacking}
        found: list[SceneRow] = []
        for row, differences in zip(self.pairs.rows, self.pairs.differences, strict=True):
            if len(differences):
                test = None if row.scene in lacking else t_test(differences[None])
                interval = None if test is None else test.interval(ALPHA)
                found.append((row.scene, float(differences.mean()), len(differences), interval))
        return found

    @cached_property
    def notes(self) -> list[Note]:
        """Notes on its trials, beside the reason why it is untestable."""
        found = [*self.pairs.left_out, *between_scenes_notes(*self.pairs.sides)]
        return [note for note in found if note != self.untestable]

    @property
    def least(self) -> float | None:
        """The least difference that matters, in the unit of the test.

        A relative question is tested in logarithms.
        """
        least = self.question.least
        return math.log1p(least) if self.question.relative and least is not None else least

    @property
    def mean(self) -> float | None:
        return float(self.pairs.differences.mean()) if self.pairs.seeds else None

    @property
    def interval(self) -> Interval | None:
        return None if self.test is None else self.test.interval(self.level)

    @property
    def p(self) -> float | None:
        return None if self.test is None else self.test.p

    @property
    def statements(self) -> int:
        """The number of statements that it makes or will make, each at its level."""
        return self.is_tested * (1 + (self.like_these is not None))

    @property
    def relative(self) -> float:
        """The mean difference relative to the baseline's value."""
        if self.mean is None:
            return math.nan
        if self.pairs.relative:
            return math.expm1(self.mean)
        return self.mean / self.pairs.baseline if self.pairs.baseline else math.nan

    @property
    def deviation(self) -> float | None:
        """The deviation of paired differences within scenes; None with one pair per scene."""
        if self.pairs.seeds < 2:
            return None
        return float(np.sqrt(self.pairs.differences.var(axis=1, ddof=1).mean()))

    @property
    def equal(self) -> bool:
        """Return whether all pairs have a difference of exactly 0; False without a pair."""
        differences = self.pairs.differences
        return differences.size > 0 and not differences.any()

    def shown(self, value: float) -> str:
        """A difference as text: ``−0.0123``, or ``+28.4 %`` if the question is relative."""
        if self.question.relative:
            return f"{signed(100 * math.expm1(value), '.1f')} %"
        return signed(value, f".{self.quantity.decimals + 1}f")

    def shown_interval(self, interval: Interval) -> str:
        return f"{self.shown(interval.low)} to {self.shown(interval.high)}"


def judge(
    trials: Sequence[TrialResult], question: Question, unfinished: Sequence[Unfinished] = ()
) -> Verdict:
    """The verdict on a question by the ``trials`` of its experiment, done or ``unfinished``.

    Trials of which it does not ask change nothing. It waits until all its trials are done or have
    failed; with looks, it is answered at the first look that decides it.
    """
    own = [one for one in trials if question.has(one.digest, one.scene, one.seed)]
    open_ = [one for one in unfinished if one.is_of(question)]
    pairs = pair(own, question)
    verdict = Verdict(
        question,
        asked_quantity(question.metric, own),
        pairs,
        _state(question, own, open_),
        question.level,
        done=len(own) + sum(one.failed for one in open_),
        missing=tuple(one for one in open_ if not one.failed),
    )
    if why := _untestable(verdict):
        return replace(verdict, untestable=why)
    if question.looks and verdict.is_tested:
        return _at_looks(verdict)
    if verdict.state == "answered":
        return _without_lacking(_decide(verdict), own, open_)
    return replace(_measure(verdict), final=not verdict.is_tested)


def _state(
    question: Question, own: Sequence[TrialResult], unfinished: Sequence[Unfinished]
) -> State:
    if question.untested:
        return "not tested"
    ideas = {second for _, second in question.digests.values()}
    # gates, ledgers and old declarations know by themselves what was asked before
    if question.rule == "command" and not all(
        one.record.questions for one in own if one.digest in ideas
    ):
        return "not asked beforehand"
    ended = len(own) + sum(one.failed for one in unfinished)
    if ended >= question.trials:
        return "answered"
    return "running" if any(one.running for one in unfinished) else "stopped"


def _untestable(verdict: Verdict) -> Note | None:
    """The reason why the question's trials can never answer it."""
    pairs = verdict.pairs
    same = [note for note in pairs.left_out if note.kind in (SAME_CAPTURE, "unlike")]
    if same or (pairs.left_out and not pairs.rows and verdict.state == "answered"):
        return (*same, *pairs.left_out)[0]
    if (
        pairs.rows
        and verdict.state == "answered"
        and all(are_equal(*both) for row in pairs.rows for both in row.trials)
    ):
        return Note.of("equal", pairs=sum(len(row.trials) for row in pairs.rows))
    return None


def _at_looks(asked: Verdict) -> Verdict:
    """Judge at each look that has all its trials, and stop at the first look that decides."""
    looks, rate = asked.question.looks, asked.question.level
    verdict = replace(asked, pairs=asked.pairs.first(0), final=False)
    whole = len(asked.pairs.rows) == len(asked.question.seeds)
    for seeds, share in zip(looks, look_shares(len(looks)), strict=True):
        if not whole or seeds > asked.pairs.seeds:
            break
        at_look = replace(asked, pairs=asked.pairs.first(seeds), level=rate * share)
        verdict = replace(_decide(at_look), state="answered")
        decided = verdict.outcome != "undecided" or passes(verdict) or gives_up(verdict)
        verdict = replace(verdict, final=decided or seeds == looks[-1])
        if verdict.final:
            return verdict
    return replace(verdict, state="running" if asked.state == "answered" else asked.state)


def passes(verdict: Verdict) -> bool:
    """Return whether an undecided gate ends: its version is not worse by the least difference."""
    return verdict.question.rule == "gate" and _excludes(verdict, -1, verdict.interval)


def gives_up(verdict: Verdict) -> bool:
    """Return whether an undecided idea of a ledger ends: a gain is unlikely (`GIVE_UP`)."""
    if verdict.test is None or verdict.question.rule not in ("screening", "lond"):
        return False
    return _excludes(verdict, 1, verdict.test.interval(2 * GIVE_UP))


def _excludes(verdict: Verdict, toward: int, interval: Interval | None) -> bool:
    """Return whether an interval excludes a gain (``toward`` 1) or loss of the least that matters.

    False unless the verdict is undecided.
    """
    if interval is None or verdict.least is None or verdict.outcome != "undecided":
        return False
    side = verdict.question.sign * toward
    return max(side * interval.low, side * interval.high) < verdict.least


def _measure(verdict: Verdict) -> Verdict:
    """The verdict with mean and test, the outlying trials, and no outcome."""
    pairs = verdict.pairs
    test = t_test(pairs.differences) if pairs.seeds else None
    return replace(verdict, test=test, outlying=tuple(find_outlying(pairs)))


def _decide(verdict: Verdict) -> Verdict:
    verdict = _measure(verdict)
    if verdict.interval is None:
        return verdict
    sign, least = verdict.question.sign, verdict.least
    means = verdict.pairs.differences.mean(axis=1)
    return replace(
        verdict,
        outcome=outcome_of(verdict.interval, sign, least),
        like_these=judge_like_these(means, sign, least, verdict.level),
    )


def _without_lacking(
    verdict: Verdict, trials: Sequence[TrialResult], unfinished: Sequence[Unfinished]
) -> Verdict:
    """The verdict, undecided if it favours an arm that lacks results which the other arm has."""
    question, read = verdict.question, verdict.quantity.read
    ideas = {second for _, second in question.digests.values()}
    done: tuple[set[tuple[str, int]], set[tuple[str, int]]] = (set(), set())
    missing = [(one, int(one.is_of(question, 1))) for one in unfinished]
    for trial in trials:
        side = int(trial.digest in ideas)
        if read(trial) is None:
            missing.append((Unfinished(trial.path, trial.digest, failed=True), side))
        else:
            done[side].add((trial.scene, trial.seed))
    lacking = [
        (side, one) for one, side in missing if (one.scene, one.seed) in done[1 - side] - done[side]
    ]

    def favours_lacking(outcome: Outcome) -> bool:
        sides = favoured(outcome, question.sign, verdict.quantity.direction)
        return any(side in sides for side, _ in lacking)

    like, favours = verdict.like_these, favours_lacking(verdict.outcome)
    if like is not None and favours_lacking(like.outcome):
        like = replace(like, outcome="undecided")
    outcome = "undecided" if favours else verdict.outcome
    own = tuple(one for _, one in sorted(lacking, key=lambda pair: pair[0]))
    return replace(verdict, outcome=outcome, like_these=like, lacking=own, favours_lacking=favours)


def find_outlying(pairs: Pairs) -> list[TrialResult]:
    """The trials that are far from the other trials of their scene and arm.

    Far is more than `OUTLYING` deviations from the mean of the others. The deviation of two or
    three trials is often small by chance. So the largest of three counts: the other trials'
    deviation, that of the scene's other arm, and the typical deviation over all scenes and
    arms.
    """
    rows = [row for row in pairs.rows if len(row.seeds) > LEAST_OTHERS]
    deviations = [[side.std(ddof=1) for side in (row.baseline, row.arm)] for row in rows]
    typical = FEW * median_low(chain(*deviations)) if rows else 0.0
    outlying = []
    for row, both in zip(rows, deviations, strict=True):
        for side, values in enumerate((row.baseline, row.arm)):
            others = np.stack([np.delete(values, index) for index in range(len(values))])
            deviation = np.maximum(others.std(axis=1, ddof=1), max(both[1 - side], typical))
            is_far = np.abs(values - others.mean(axis=1)) > OUTLYING * deviation
            far = np.flatnonzero(is_far & (deviation > 0))
            outlying += [row.trials[index][side] for index in far]
    return outlying


def interval_of(
    trials: Sequence[TrialResult],
    baseline: Arm,
    idea: Arm,
    metric: str,
    state: State = "not tested",
    why: str = "",
) -> Verdict:
    """Mean and 95 % interval of all trials of two arms in any metric; it is no verdict."""
    own = trials_of(trials, baseline, idea)
    quantity = asked_quantity(metric, own)
    first, second = (
        {(trial.scene, trial.seed) for trial in own if trial.arm == arm} for arm in (baseline, idea)
    )
    seeds: dict[str, tuple[int, ...]] = {}
    for scene, seed in sorted(first & second):
        seeds[scene] = (*seeds.get(scene, ()), seed)
    question = Question(
        idea=idea,
        baseline=baseline,
        metric=metric,
        sign=quantity.direction,  # type: ignore[arg-type]
        least=quantity.worthwhile,
        digests=dict.fromkeys(seeds, ("baseline", "idea")),
        seeds=seeds,
        untested=why or state,
    )
    pairs = pair(own, question, lambda trial: "idea" if trial.arm == idea else "baseline")
    return _measure(Verdict(question, quantity, pairs, state, ALPHA, done=len(own)))
