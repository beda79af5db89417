"""The verdicts on the questions of a declaration. `judge` is the only code that decides them.

It serves reports, tables, checks of claims, sweeps that stop when decided and ablations, and gets
its pairs of trials from `gsbench.analysis.pairing.pair`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsbench.analysis.differences import between_scenes_notes
from gsbench.analysis.looks import look_levels
from gsbench.analysis.notes import Note
from gsbench.analysis.pairing import SAME_CAPTURE, Pairs, are_equal, pair
from gsbench.analysis.quantities import Quantity, asked_quantity
from gsbench.analysis.results import Arm, TrialResult, group_by
from gsbench.analysis.statistics import (
    TOO_SMALL,
    UNDECIDED,
    Answer,
    Interval,
    LikeThese,
    Outcome,
    answer_family,
    favoured,
    judge_like_these,
    t_test,
)
from gsbench.analysis.unfinished import Unfinished, one_sided
from gsbench.runs.experiments import NO_TIME, Declaration, Question
from gsbench.words import signed

# deviations from the other trials of its scene and arm, beyond which a trial is outlying
OUTLYING = 5.0
LEAST_OTHERS = 2  # the fewest other trials that this needs
# corrects the median sample deviation of three trials, which is too small: 1 / sqrt(ln 2)
FEW = 1.2


@dataclass(frozen=True)
class SceneVerdict:
    """The mean paired difference of one scene.

    Its test is adjusted for all scenes of all questions; without a test if one arm lacks results.
    """

    scene: str
    mean: float
    seeds: int
    interval: Interval | None
    p: float | None


@dataclass(frozen=True)
class Verdict:
    """The answer to a question from ``pairs`` of trials.

    ``answer`` is about these scenes, None if no trials could be paired; ``like_these`` is about
    scenes like these. ``untestable`` says why such trials can never answer the question. ``final``
    is False while further planned seeds may decide. ``outlying`` trials lie far outside the others
    of their scene and arm; ``outcome_without`` is the outcome without them. If the mean of the
    other trials contradicts the outcome, the verdict ``rests_on_outlying`` trials and is undecided.
    ``seen`` are the arm's trials that were measured before the question. If there are any, each
    metric could have been chosen by its result, and the error rate is divided by the number of
    metrics.
    ``lacking`` are trials of one arm without a result where the other arm has one; if the outcome
    favoured that arm, the verdict ``favours_lacking`` and is undecided.
    """

    question: Question
    quantity: Quantity
    pairs: Pairs
    outcome: Outcome = "undecided"
    answer: Answer | None = None
    like_these: LikeThese | None = None
    scenes: tuple[SceneVerdict, ...] = ()
    family: int = 1
    # the arms of the family's questions, without those of claims, which have names
    family_arms: tuple[str, ...] = ()
    final: bool = True
    untestable: Note | None = None
    outlying: tuple[TrialResult, ...] = ()
    outcome_without: Outcome | None = None
    rests_on_outlying: bool = False
    lacking: tuple[Unfinished, ...] = ()
    favours_lacking: bool = False
    seen: tuple[TrialResult, ...] = ()
    notes: tuple[Note, ...] = ()

    @property
    def least(self) -> float | None:
        """The least difference that matters, in the unit of the test.

        A relative question is tested in logarithms.
        """
        least = self.question.least
        return math.log1p(least) if self.question.relative and least is not None else least

    @property
    def mean(self) -> float | None:
        if self.answer is None:
            return 0.0 if self.equal else None
        return self.answer.mean

    @property
    def interval(self) -> Interval | None:
        return None if self.answer is None else self.answer.interval

    @property
    def p(self) -> float | None:
        return None if self.answer is None else self.answer.p

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
        # Before the first look, the rows of a sweep in looks have no pairs yet.
        differences = self.pairs.differences
        return differences.size > 0 and not differences.any()

    @property
    def loss_excluded(self) -> bool:
        """Return whether the interval excludes a loss of the least difference that matters.

        A verdict that rests on outlying trials shows nothing.
        """
        if self.interval is None or self.least is None or self.rests_on_outlying:
            return False
        sign = self.question.sign
        return min(sign * self.interval.low, sign * self.interval.high) > -self.least

    def gain_excluded(self, error_rate: float) -> bool:
        """Return whether a gain of the least difference that matters is excluded.

        ``error_rate`` is the chance that such a gain is excluded although it is there.
        """
        if self.answer is None or self.answer.test is None or self.least is None:
            return False
        sign, interval = self.question.sign, self.answer.test.interval(2 * error_rate)
        return max(sign * interval.low, sign * interval.high) < self.least

    def shown(self, value: float) -> str:
        """A difference as text: ``−0.0123``, or ``+28.4 %`` if the question is relative."""
        if self.question.relative:
            return f"{signed(100 * math.expm1(value), '.1f')} %"
        return signed(value, f".{self.quantity.decimals + 1}f")

    def shown_interval(self, interval: Interval) -> str:
        return f"{self.shown(interval.low)} to {self.shown(interval.high)}"


@dataclass(frozen=True)
class OtherTest:
    """A test beside the questions of a declaration.

    ``paired``: it has pairs of trials. ``p`` is None if these are too few for a test.
    """

    arm: Arm | None
    secondary: bool
    paired: bool
    p: float | None


def other_test(trials: Sequence[TrialResult], question: Question) -> OtherTest:
    """The test of a question with these trials, as `judge` would do it."""
    pairs = pair(trials, question)
    test = t_test(pairs.differences) if pairs.rows else None
    p = None if test is None else test.p
    return OtherTest(question.arm, question.secondary, bool(pairs.rows), p)


def judge(
    trials: Sequence[TrialResult],
    declaration: Declaration,
    lacking: Sequence[Unfinished] = (),
    others: Sequence[OtherTest] = (),
) -> list[Verdict]:
    """The verdicts on the questions of ``declaration``, in their order.

    ``lacking`` are the trials without a usable result (`unfinished`); a look waits for its trials,
    so they matter only without looks. Questions share the error rate. If seeds come in looks, each
    question gets an equal share and is answered at the first look that decides it; otherwise
    Holm's method adjusts them as one family. Secondary questions have an error rate of their own.
    ``others`` share the error rates without being answered here.
    """
    by_arm, by_folder = (
        group_by(trials, lambda trial: trial.arm),
        group_by(trials, lambda trial: trial.key),
    )

    def trials_of(question: Question) -> list[TrialResult]:
        # Grouped once above: searching all trials for each of many questions is slow.
        if question.scenes:
            keys = dict.fromkeys(key for both in question.scenes.values() for key in both)
            return [trial for key in keys for trial in by_folder.get(key, [])]
        return [trial for arm in (question.baseline, question.arm) for trial in by_arm.get(arm, [])]  # type: ignore[arg-type]

    # Pairs come first: which questions have any decides the size of a family, and so each test.
    unjudged = [
        _with_pairs(trials_of(question), question, declaration)
        for question in declaration.questions
    ]
    judged = list(unjudged)
    testable = [k for k, one in enumerate(unjudged) if one.pairs.rows and not one.untestable]
    for secondary in (False, True):
        family = [k for k in testable if unjudged[k].question.secondary == secondary]
        beside = [one for one in others if one.secondary == secondary]
        # With looks, the shares of the error rate were fixed when it was declared: questions
        # without pairs keep theirs.
        is_declared = declaration.time != NO_TIME
        sharing = len(beside) + sum(
            question.secondary == secondary and (is_declared or k in family)
            for k, question in enumerate(declaration.questions)
        )
        if declaration.looks:
            for k in family:
                rate = declaration.error_rate / sharing / _candidate_metrics(unjudged[k])
                judged[k] = _at_looks(unjudged[k], declaration.looks, rate)
        else:
            candidates = max((_candidate_metrics(unjudged[k]) for k in family), default=1)
            differences = [unjudged[k].pairs.differences for k in family]
            tests = [other for other in beside if other.paired]
            known = [test.p for test in tests if test.p is not None]
            answers = answer_family(differences, declaration.error_rate / candidates, known)
            asked = [unjudged[k].question for k in family]
            arms = {str(question.arm) for question in asked if question.arm and not question.name}
            named = tuple(sorted(arms | {str(test.arm) for test in tests}))
            for k, answer in zip(family, answers, strict=True):
                size = len(family) + len(tests)
                own = replace(unjudged[k], family=size, family_arms=named)
                decided = _decide(own, answer)
                judged[k] = _without_lacking(decided, trials_of(decided.question), lacking)
    return _with_scenes(judged, declaration.error_rate)


def _with_pairs(
    trials: Sequence[TrialResult], question: Question, declaration: Declaration
) -> Verdict:
    """The question with its pairs of trials, not judged yet."""
    pairs = pair(trials, question)
    # the baseline's trials alone show no difference, so they may be older
    seen = tuple(trial for trial in pairs.of_arm if trial.measured < declaration.moment)
    quantity = asked_quantity(question.metric, trials)
    notes = pairs.left_out
    if question.scenes:  # other questions are below tables, which say it themselves
        notes += tuple(between_scenes_notes(pairs.of_baseline, pairs.of_arm))
    verdict = Verdict(
        question, quantity, pairs, notes=notes, seen=seen, final=not declaration.looks
    )
    same = [note for note in pairs.left_out if note.kind == SAME_CAPTURE]
    if question.scenes and (same or (pairs.left_out and not pairs.rows)):
        reasons = dict.fromkeys([*same, *pairs.left_out])
        why, *others = reasons
        return replace(verdict, untestable=why, notes=tuple(others), final=True)
    if question.scenes and len(pairs.rows) < len(question.scenes):  # a look waits for every scene
        none = pairs.first(0) if declaration.looks else replace(pairs, rows=())
        return replace(verdict, pairs=none)
    if (
        pairs.rows
        and question.scenes
        and all(are_equal(*both) for row in pairs.rows for both in row.trials)
    ):
        count = sum(len(row.trials) for row in pairs.rows)
        return replace(verdict, untestable=Note.of("equal", pairs=count), final=True)
    return verdict


def _candidate_metrics(verdict: Verdict) -> int:
    """The number of metrics that could have been chosen by their results.

    It is 1 if the question was asked beforehand.
    """
    if not verdict.seen:
        return 1
    return len(
        {name for trial in verdict.pairs.trials for name in trial.metrics}
        | {verdict.question.metric}
    )


def _at_looks(asked: Verdict, looks: tuple[int, ...], rate: float) -> Verdict:
    """Judge at each look that has enough seeds, and stop at the first look that decides."""
    verdict = replace(asked, pairs=asked.pairs.first(0), final=False)
    for seeds, level in zip(looks, look_levels(len(asked.pairs.rows), looks, rate), strict=True):
        if seeds > asked.pairs.seeds:
            break
        pairs = asked.pairs.first(seeds)
        test = t_test(pairs.differences)
        answer = Answer(float(pairs.differences.mean()), test, rate, level, level)
        verdict = _decide(replace(asked, pairs=pairs), answer)
        verdict = replace(verdict, final=verdict.outcome != UNDECIDED or seeds == looks[-1])
        if verdict.final:
            break
    return verdict


def _decide(verdict: Verdict, answer: Answer) -> Verdict:
    """The verdict with its outcome; undecided if it rests on outlying trials."""
    question, least, pairs = verdict.question, verdict.least, verdict.pairs
    level = answer.level / verdict.family
    about_like_these = judge_like_these(pairs.differences.mean(axis=1), question.sign, least, level)
    outcome = answer.outcome(question.sign, least)
    outcome_without, rests_on_outlying = None, False
    if outlying := find_outlying(pairs):
        rest = pairs.without(outlying)
        answer_without = replace(answer, test=t_test(rest.differences) if rest.rows else None)
        outcome_without = answer_without.outcome(question.sign, least)
        if rest.rows:
            rests_on_outlying = _contradicts(
                float(rest.differences.mean()), answer.mean, outcome, least
            )
    return replace(
        verdict,
        answer=answer,
        like_these=about_like_these,
        outcome="undecided" if rests_on_outlying else outcome,
        outlying=tuple(outlying),
        outcome_without=outcome_without,
        rests_on_outlying=rests_on_outlying,
    )


def _without_lacking(
    verdict: Verdict, trials: Sequence[TrialResult], unfinished: Sequence[Unfinished]
) -> Verdict:
    """The verdict, undecided if it favours an arm that lacks results which the other arm has."""
    by_value = group_by(trials, lambda trial: verdict.quantity.read(trial) is not None)
    valueless = [Unfinished(trial.path) for trial in by_value.get(False, [])]
    lacking = one_sided(verdict.question, by_value.get(True, []), [*unfinished, *valueless])

    def favours_lacking(outcome: Outcome) -> bool:
        sides = favoured(outcome, verdict.question.sign, verdict.quantity.direction)
        return any(lacking[side] for side in sides)

    like, favours = verdict.like_these, favours_lacking(verdict.outcome)
    if like is not None and favours_lacking(like.outcome):
        like = replace(like, outcome=UNDECIDED)
    return replace(
        verdict,
        outcome=UNDECIDED if favours else verdict.outcome,
        like_these=like,
        lacking=(*lacking[0], *lacking[1]),
        favours_lacking=favours,
    )


def _contradicts(rest: float, mean: float, outcome: Outcome, least: float | None) -> bool:
    """Return whether ``rest``, the mean without outlying trials, contradicts ``outcome``.

    The outcome follows from ``mean``, the mean of all trials. It is contradicted if ``rest`` is
    not too small although the outcome says so, or if ``rest`` has the other sign.
    """
    if outcome == TOO_SMALL:
        return least is not None and abs(rest) >= least
    return outcome != UNDECIDED and rest * mean <= 0


def find_outlying(pairs: Pairs) -> list[TrialResult]:
    """The trials that are far from the other trials of their scene and arm.

    Far is more than `OUTLYING` deviations from the mean of the others. The deviation of two or
    three trials is often small by chance. So the largest of three counts: the other trials'
    deviation, that of the scene's other arm, and the typical deviation over all scenes and
    arms.
    """
    rows = [row for row in pairs.rows if len(row.seeds) > LEAST_OTHERS]
    deviations = [(float(row.baseline.std(ddof=1)), float(row.arm.std(ddof=1))) for row in rows]
    ordered = sorted(deviation for both in deviations for deviation in both)
    typical = FEW * ordered[(len(ordered) - 1) // 2] if ordered else 0.0
    outlying = []
    for row, both in zip(rows, deviations, strict=True):
        for side, values in enumerate((row.baseline, row.arm)):
            for index, value in enumerate(values):
                others = np.delete(values, index)
                deviation = max(float(others.std(ddof=1)), both[1 - side], typical)
                if abs(value - others.mean()) > OUTLYING * deviation > 0:
                    outlying.append(row.trials[index][side])
    return outlying


def _with_scenes(verdicts: Sequence[Verdict], level: float) -> list[Verdict]:
    """The verdicts with a `SceneVerdict` for each scene.

    All scenes of all questions are one family. If a question has one scene, that scene has the
    question's own answer.
    """
    several = [
        verdict.pairs.differences
        for verdict in verdicts
        if verdict.answer is not None and len(verdict.pairs.rows) > 1
    ]
    answers = iter(
        answer_family([row[None] for differences in several for row in differences], level)
    )
    completed = []
    for verdict in verdicts:
        scenes = []
        for row in verdict.pairs.rows:
            answer = (
                next(answers) if verdict.answer and len(verdict.pairs.rows) > 1 else verdict.answer
            )
            if answer is not None:
                tested = row.scene not in {trial.scene for trial in verdict.lacking}
                interval, p = (answer.interval, answer.p) if tested else (None, None)
                scenes.append(
                    SceneVerdict(row.scene, answer.mean, verdict.pairs.seeds, interval, p)
                )
        completed.append(replace(verdict, scenes=tuple(scenes)))
    return completed
