"""The one engine of evidence: `judge` says what the pairs of trials say that a declaration's questions compare.

Reports, tables, checks of claims, sweeps that stop when decided, planning, ablation and pooling call it and
`gsbench.analysis.pairing.pair`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsbench.analysis.pairing import Pairs, TrialPair, pair
from gsbench.analysis.quantities import Quantity, asked_quantity
from gsbench.analysis.results import TrialResult, by_key
from gsbench.analysis.statistics import (
    TOO_SMALL,
    UNDECIDED,
    Answer,
    Interval,
    LikeThese,
    Outcome,
    answer_family,
    like_these,
    look_levels,
    student,
)
from gsbench.runs.declaration import Declaration, Question
from gsbench.words import counted, signed

OUTLYING = 5.0  # deviations of other trials of its scene and arm, beyond which a trial is named
LEAST_OTHERS = 2  # trials that one must be held against
FEW = 1.2  # the deviation in medians of the deviations of three trials, which come out too small


@dataclass(frozen=True)
class SceneVerdict:
    """One scene of a verdict: the mean of its pairs' differences, its test adjusted for all scenes of all questions."""

    scene: str
    mean: float
    deviation: float | None
    seeds: int
    interval: Interval | None
    p: float | None


@dataclass(frozen=True)
class Verdict:
    """The answer to a question from the ``pairs`` that count.

    ``answer`` is about these scenes, None where nothing could be paired; ``like_these`` about scenes like them.
    ``untestable`` says why the question cannot be answered from such trials at all. ``seeds`` is the look that
    decided, or the last one so far; ``final`` is False where further seeds are planned and may decide. Trials far
    outside the others of their scene and arm are ``outlying``; ``without`` is what is said without them. A verdict that
    ``hangs`` on them, since the mean of the others contradicts it, is undecided. ``late`` trials had been measured
    before the question was asked; then the metric is one of all that could have been chosen, and has its part of the
    error rate.
    """

    question: Question
    quantity: Quantity
    pairs: Pairs
    outcome: Outcome = "undecided"
    answer: Answer | None = None
    like_these: LikeThese | None = None
    scenes: tuple[SceneVerdict, ...] = ()
    family: int = 1
    final: bool = True
    untestable: str = ""
    outlying: tuple[TrialResult, ...] = ()
    without: Outcome | None = None
    hangs: bool = False
    late: int = 0
    notes: tuple[str, ...] = ()

    @property
    def least(self) -> float | None:
        return margin(self.question)

    @property
    def mean(self) -> float | None:
        return None if self.answer is None else self.answer.mean

    @property
    def interval(self) -> Interval | None:
        return None if self.answer is None else self.answer.interval

    @property
    def p(self) -> float | None:
        return None if self.answer is None else self.answer.p

    @property
    def relative(self) -> float:
        """The mean difference as a part of the baseline's value."""
        if self.mean is None:
            return math.nan
        if self.pairs.relative:
            return math.expm1(self.mean)
        return self.mean / self.pairs.baseline if self.pairs.baseline else math.nan

    @property
    def deviation(self) -> float | None:
        """The deviation of pairs within scenes; None without a repetition."""
        values = self.pairs.differences if self.pairs.rows else np.empty((0, 0))
        return float(np.sqrt(values.var(axis=1, ddof=1).mean())) if self.pairs.seeds > 1 else None

    @property
    def equal(self) -> bool:
        """Return whether no pair differs at all."""
        return bool(self.pairs.rows) and not self.pairs.differences.any()

    def shown(self, value: float) -> str:
        """A difference as people read it: ``−0.0123``, or ``+28.4 %`` of one that is a part of the baseline's."""
        if self.question.relative:
            return f"{signed(100 * math.expm1(value), '.1f')} %"
        return signed(value, f".{self.quantity.decimals + 1}f")

    def shown_interval(self, interval: Interval) -> str:
        return f"{self.shown(interval.low)} to {self.shown(interval.high)}"


def margin(question: Question) -> float | None:
    """The least difference that matters, in the scale in which trials are compared."""
    return math.log1p(question.least) if question.relative and question.least is not None else question.least


def judge(trials: Sequence[TrialResult], declaration: Declaration) -> list[Verdict]:
    """The verdict on each question of ``declaration`` from those of ``trials`` that it compares, in their order.

    Questions share the error rate. Where seeds come in looks, they share it equally, and each is answered at the first
    look that decides it; otherwise they are one family by Holm's method. Secondary questions have a rate of their own.
    """
    by_arm, by_folder = by_key(trials, lambda trial: trial.arm), by_key(trials, lambda trial: trial.key)

    def own(question: Question) -> list[TrialResult]:
        """The trials of the question's arms: to search all trials for each of many questions takes long."""
        if question.scenes:
            keys = dict.fromkeys(key for both in question.scenes.values() for key in both)
            return [trial for key in keys for trial in by_folder.get(key, [])]
        return [trial for arm in (question.baseline, question.arm) for trial in by_arm.get(arm, [])]  # type: ignore[arg-type]

    asked = [_asked(own(question), question, declaration) for question in declaration.questions]
    found: dict[int, Verdict] = {k: one for k, one in enumerate(asked) if one.untestable or not one.pairs.rows}
    for secondary in (False, True):
        places = [k for k, one in enumerate(asked) if k not in found and one.question.secondary == secondary]
        sharing = sum(question.secondary == secondary for question in declaration.questions)
        if declaration.looks:
            for k in places:
                rate = declaration.error_rate / sharing / _candidates(asked[k])
                found[k] = _at_looks(asked[k], declaration.looks, rate)
        else:
            late = max((_candidates(asked[k]) for k in places), default=1)
            answers = answer_family([asked[k].pairs.differences for k in places], declaration.error_rate / late)
            for k, answer in zip(places, answers, strict=True):
                found[k] = _answered(replace(asked[k], family=len(places)), answer)
    return _with_scenes([found[k] for k in range(len(asked))], declaration.error_rate)


def _asked(trials: Sequence[TrialResult], question: Question, declaration: Declaration) -> Verdict:
    """The question with its pairs, before it is answered."""
    pairs = pair(trials, question)
    new = pairs.trials[1::2] if question.versions else pairs.trials  # a baseline alone tells no difference
    late = sum(trial.measured < declaration.moment for trial in new)
    quantity = asked_quantity(question.metric, trials)
    verdict = Verdict(question, quantity, pairs, notes=pairs.left_out, late=late, final=not declaration.looks)
    if not pairs.rows and pairs.left_out and question.scenes:
        return replace(verdict, untestable=pairs.left_out[0], notes=pairs.left_out[1:], final=True)
    if question.scenes and len(pairs.rows) < len(question.scenes):  # a look waits for every scene
        return replace(verdict, pairs=replace(pairs, rows=()))
    if pairs.rows and question.scenes and all(_is_equal(both) for row in pairs.rows for both in row.trials):
        count = sum(len(row.trials) for row in pairs.rows)
        reason = (
            f"both arms of {counted(count, 'pair')} of trials are equal to the last bit: the settings that differ had "
            "no effect at this size"
        )
        return replace(verdict, untestable=reason, final=True)
    return verdict


def _candidates(verdict: Verdict) -> int:
    """The number of metrics of which the question's could have been chosen: one where it was asked beforehand."""
    if not verdict.late:
        return 1
    return len({name for trial in verdict.pairs.trials for name in trial.metrics} | {verdict.question.metric})


def _at_looks(asked: Verdict, looks: tuple[int, ...], rate: float) -> Verdict:
    """Go through the looks that the trials suffice for, and stop at the first that decides."""
    verdict = replace(asked, pairs=asked.pairs.first(0), final=False)
    for seeds, level in zip(looks, look_levels(len(asked.pairs.rows), looks, rate), strict=True):
        if seeds > asked.pairs.seeds:
            break
        pairs = asked.pairs.first(seeds)
        test = student(pairs.differences)
        answer = Answer(float(pairs.differences.mean()), test, rate, level, level)
        verdict = _answered(replace(asked, pairs=pairs), answer)
        verdict = replace(verdict, final=verdict.outcome != UNDECIDED or seeds == looks[-1])
        if verdict.final:
            break
    return verdict


def _answered(verdict: Verdict, answer: Answer) -> Verdict:
    """The verdict with its outcome; undecided where it hangs on trials that lie far outside the others."""
    question, least, pairs = verdict.question, margin(verdict.question), verdict.pairs
    level = answer.level if question.scenes else answer.level / verdict.family
    about = like_these(pairs.differences.mean(axis=1), question.sign, least, level)
    outcome = answer.outcome(question.sign, least)
    without, hangs = None, False
    if outlying := find_outlying(pairs):
        rest = pairs.without(outlying)
        fewer = replace(answer, test=student(rest.differences)) if rest.rows else replace(answer, test=None)
        without = fewer.outcome(question.sign, least)
        hangs = bool(rest.rows) and _contradicts(float(rest.differences.mean()), answer.mean, outcome, least)
    return replace(
        verdict,
        answer=answer,
        like_these=about,
        outcome="undecided" if hangs else outcome,
        outlying=tuple(outlying),
        without=without,
        hangs=hangs,
    )


def _contradicts(rest: float, mean: float, outcome: Outcome, least: float | None) -> bool:
    """Return whether the mean of the other trials has the other sign, or is not too small, where all decided so."""
    if outcome == TOO_SMALL:
        return least is not None and abs(rest) >= least
    return outcome != UNDECIDED and rest * mean <= 0


def find_outlying(pairs: Pairs) -> list[TrialResult]:
    """The trials that lie more than `OUTLYING` deviations outside the others of their scene and arm.

    The deviation is the largest of the others' own, that of the scene's other arm, and the typical one of all scenes,
    since that of two or three trials is often small by chance.
    """
    rows = [row for row in pairs.rows if len(row.seeds) > LEAST_OTHERS]
    spreads = [(float(row.before.std(ddof=1)), float(row.after.std(ddof=1))) for row in rows]
    ordered = sorted(spread for both in spreads for spread in both)
    typical = FEW * ordered[(len(ordered) - 1) // 2] if ordered else 0.0
    found = []
    for row, both in zip(rows, spreads, strict=True):
        for side, values in enumerate((row.before, row.after)):
            for place, value in enumerate(values):
                others = np.delete(values, place)
                deviation = max(float(others.std(ddof=1)), both[1 - side], typical)
                if abs(value - others.mean()) > OUTLYING * deviation > 0:
                    found.append(row.trials[place][side])
    return found


def _is_equal(both: TrialPair) -> bool:
    """Return whether the two models are one and the same, as far as numbers tell."""
    one, other = both
    same_count = one.record.num_gaussians == other.record.num_gaussians
    return bool(one.metrics) and one.metrics == other.metrics and same_count


def _with_scenes(verdicts: Sequence[Verdict], level: float) -> list[Verdict]:
    """The verdicts with their single scenes, which are one family over all questions; one scene is the whole."""
    rows = [verdict.pairs.differences if verdict.answer is not None else np.empty((0, 1)) for verdict in verdicts]
    answers = iter(answer_family([row[None] for own in rows if len(own) > 1 for row in own], level))
    return [
        replace(
            verdict,
            scenes=tuple(
                SceneVerdict(
                    scene,
                    float(row.mean()),
                    float(row.std(ddof=1)) if len(row) > 1 else None,
                    len(row),
                    *(
                        (one.interval, one.p)
                        if (one := next(answers) if len(own) > 1 else verdict.answer)
                        else (None, None)
                    ),
                )
                for scene, row in zip(verdict.pairs.scenes, own, strict=True)
            )
            if verdict.answer is not None
            else (),
        )
        for verdict, own in zip(verdicts, rows, strict=True)
    ]
