"""All answers of an experiment, made once: every verb, table and page shows these.

An idea has a row. Its verdict is that of its last answered question about the present code; its
other questions stand below, and so do other metrics, which are not tested. What nobody asked
beforehand has a mean and an interval.
"""

import itertools
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from gsbench.analysis.cells import with_variants
from gsbench.analysis.notes import Note, texts
from gsbench.analysis.old_declarations import all_questions
from gsbench.analysis.quantities import choose_quantities
from gsbench.analysis.questions import Asked, choose_pairs
from gsbench.analysis.results import Arm, Experiment, TrialResult, group_by
from gsbench.analysis.sentences import asked_words, badge, headline, risk, sentence
from gsbench.analysis.statistics import REFUTED, SUPPORTED
from gsbench.analysis.verdicts import (
    ANSWERED,
    NOT_ASKED,
    NOT_TESTED,
    Verdict,
    interval_of,
    judge,
)
from gsbench.runs.commands import Question, code_in, questions_elsewhere
from gsbench.runs.experiments import DEFAULT_METRIC
from gsbench.runs.layout import LEDGER, TUNING

OLD_LEDGER = f"the ledger of an earlier gsbench decided ({LEDGER})"


@dataclass(frozen=True)
class Answer:
    """Verdicts on an idea against a baseline.

    ``verdict`` is that of the last answered question about the present code; else of the last
    question, or an interval that nobody asked for. ``others`` are the verdicts on its other
    questions, the newest first; ``metrics`` the intervals of all other metrics. ``earlier``: it is
    about trials of code that was edited since.
    """

    baseline: Arm
    arm: Arm
    verdict: Verdict
    others: tuple[Verdict, ...] = ()
    metrics: tuple[Verdict, ...] = ()
    earlier: bool = False

    @property
    def badge(self) -> str:
        return badge(self.verdict)

    @property
    def sentence(self) -> str:
        return sentence(self.verdict) + self._remark

    @property
    def headline(self) -> str:
        """``random-mine against random-adc: BETTER, PSNR (dB) +0.50``"""
        return headline(self.verdict) + self._remark

    @property
    def _remark(self) -> str:
        return " (earlier code)" if self.earlier else ""

    @property
    def line(self) -> str:
        """``BETTER: sfm-mine against sfm-adc: better in PSNR (dB) on these scenes: +0.50 …``"""
        return f"{self.badge}: {self.sentence}"


@dataclass(frozen=True)
class Comparison:
    """The answers of an experiment; ``trials`` are those that count, with their variants."""

    experiment: Experiment
    trials: tuple[TrialResult, ...]
    answers: tuple[Answer, ...]

    @property
    def pairs(self) -> tuple[tuple[Arm, Arm], ...]:
        """The pairs of baseline and idea that both have trials; a baseline may be awaited."""
        known = {trial.arm for trial in self.trials}
        pairs = dict.fromkeys((answer.baseline, answer.arm) for answer in self.answers)
        return tuple(pair for pair in pairs if known.issuperset(pair))

    @property
    def sentences(self) -> list[str]:
        """The verdict on each idea, in a sentence or two each."""
        return [answer.sentence for answer in self.answers]

    @property
    def risk(self) -> str:
        """The risk of a page with these answers; "" if it states no verdict."""
        verdicts = itertools.chain(*((one.verdict, *one.others) for one in self.answers))
        return risk([one for one in verdicts if one.state == ANSWERED])

    @cached_property
    def remarks(self) -> list[Note]:
        """Notes that belong to the sentences, wherever they stand."""
        compared = {arm for one in self.answers for arm in (one.baseline, one.arm)}
        alone = [arm for arm in dict.fromkeys(t.arm for t in self.trials) if arm not in compared]
        notes = [Note.of("no partner", arm=arm) for arm in alone if self.answers or len(alone) > 1]
        for answer in self.answers:
            used = {trial.path for trial in answer.verdict.pairs.trials}
            own = [trial for trial in self.trials if trial.arm in (answer.arm, answer.baseline)]
            # the baseline may have more seeds and scenes: they cost nothing
            unused = [t for t in own if t.arm == answer.arm and t.path not in used]
            if unused and answer.verdict.state == ANSWERED:
                labels = [trial.label for trial in unused]
                notes.append(Note.of("unused", trials=labels, arm=answer.arm))
            notes += [note for note in answer.verdict.notes if note.kind == "valueless"]
        return [*notes, *same_bits_notes(self.trials)]

    def to_json(self) -> dict[str, Any]:
        """The verdicts and what is left out, for other programs."""
        left_out = texts([*self.remarks, *self.experiment.warnings])
        return {
            "answers": [_as_json(answer) for answer in self.answers],
            "risk": self.risk,
            "left_out": left_out,
        }


def _as_json(answer: Answer) -> dict[str, Any]:
    return {
        "arm": str(answer.arm),
        "baseline": str(answer.baseline),
        "badge": answer.badge,
        "sentence": answer.sentence,
        "notes": texts(answer.verdict.notes),
        "verdicts": [
            verdict_json(one) for one in (answer.verdict, *answer.others, *answer.metrics)
        ],
    }


def verdict_json(verdict: Verdict) -> dict[str, Any]:
    """A verdict for other programs."""
    interval = verdict.interval
    return {
        "metric": verdict.question.metric,
        "state": verdict.state,
        "outcome": verdict.outcome,
        "difference": verdict.mean,
        "interval": None if interval is None else [interval.low, interval.high],
        "p": verdict.p,
        "level": verdict.level,
        "n": verdict.question.n,
        "question": verdict.question.id,
        "asked": asked_words(verdict),
        "trials": [trial.label for trial in verdict.pairs.trials],
    }


def compare(experiment: Experiment, baseline: str | None = None) -> Comparison:
    """The answers of an experiment, those about earlier code last.

    With ``baseline``, a densifier, each other arm is shown against it, with intervals alone: the
    baseline was chosen after the results.
    """
    trials = tuple(with_variants(experiment.trials))
    if (experiment.folder / TUNING).exists():
        # the points of a search were chosen by results, so no test of them is valid
        return Comparison(experiment, trials, ())
    if baseline is not None:
        pairs = choose_pairs(trials, Asked(metric=DEFAULT_METRIC, baseline=baseline))
        known = {trial.arm for trial in trials}
        answers = [
            _with_metrics(interval_of(trials, *pair, DEFAULT_METRIC), trials, *pair)
            for pair in pairs
            if known.issuperset(pair)
        ]
        return Comparison(experiment, trials, tuple(answers))
    return Comparison(experiment, trials, tuple(_answers(experiment, trials)))


def _answers(experiment: Experiment, trials: Sequence[TrialResult]) -> list[Answer]:
    everything = [*trials, *experiment.older]
    arms = {(trial.scene, trial.digest): trial.arm for trial in trials}
    # questions that an experiment's file names have an answer each
    verdicts: dict[tuple[Arm, Arm, str], list[Verdict]] = {}
    for question in all_questions(experiment):
        question = _named(question, arms)
        verdict = judge(everything, question, experiment.unfinished)
        key = question.baseline, question.idea, question.name
        verdicts.setdefault(key, []).append(verdict)
    ideas = {idea for _, idea, _ in verdicts}
    unasked = [
        pair
        for pair in choose_pairs(trials, Asked(metric=DEFAULT_METRIC))
        if pair[1] not in ideas and {trial.arm for trial in trials}.issuperset(pair)
    ]
    answers = []
    folded = {trial.path for trial in experiment.older}
    for (first, second, _), own in verdicts.items():
        newest = own[-1].question
        code = {code_in(second) for _, second in newest.digests.values()}
        current = [
            one
            for one in own
            if {code_in(second) for _, second in one.question.digests.values()} == code
        ]
        answered = [one for one in current if one.state == ANSWERED]
        shown = (answered or current)[-1]
        others = tuple(one for one in reversed(own) if one is not shown)
        earlier = any(trial.path in folded for trial in shown.pairs.trials)
        answer = _with_metrics(shown, trials, first, second, others)
        answers.append(replace(answer, earlier=earlier))
    answers.sort(key=lambda answer: answer.earlier)
    state, why = NOT_ASKED, ""
    if (experiment.folder / LEDGER).exists():
        state, why = NOT_TESTED, OLD_LEDGER
    for pair in unasked:
        shown = interval_of(trials, *pair, DEFAULT_METRIC, state, why)
        answers.append(_with_metrics(shown, trials, *pair))
    return _with_askers(experiment, answers)


def _with_askers(experiment: Experiment, answers: Sequence[Answer]) -> list[Answer]:
    """The answers; one that nobody asked here names another experiment that asked it.

    The other experiments are read once, and only if there is such an answer.
    """
    if all(answer.verdict.state != NOT_ASKED for answer in answers):
        return [*answers]
    elsewhere = questions_elsewhere(experiment.folder)
    return [
        replace(answer, verdict=replace(answer.verdict, asker=_asker(answer.verdict, elsewhere)))
        for answer in answers
    ]


def _asker(verdict: Verdict, elsewhere: Mapping[str, Sequence[Question]]) -> str:
    """The experiment with a question about all trials of a verdict that nobody asked, or ""."""
    trials = verdict.pairs.trials
    if verdict.state != NOT_ASKED or not trials:
        return ""

    def asks(question: Question) -> bool:
        return question.metric == verdict.quantity.key and all(
            question.has(trial.digest, trial.scene, trial.seed) for trial in trials
        )

    return next((name for name, asked in elsewhere.items() if any(map(asks, asked))), "")


def _named(question: Question, arms: Mapping[tuple[str, str], Arm]) -> Question:
    """The question with the names that its arms have among all trials."""
    sides = []
    for side, name in enumerate((question.baseline, question.idea)):
        found = (arms.get((scene, both[side])) for scene, both in question.digests.items())
        sides.append(next(filter(None, found), name))
    return replace(question, baseline=sides[0], idea=sides[1])


def _with_metrics(
    verdict: Verdict,
    trials: Sequence[TrialResult],
    baseline: Arm,
    arm: Arm,
    others: tuple[Verdict, ...] = (),
) -> Answer:
    own = [trial for trial in trials if trial.arm in (baseline, arm)]
    known = [*(choose_quantities(own) if own else ()), *(one.quantity for one in others)]
    metrics = tuple(
        interval_of(own, baseline, arm, quantity.key)
        for quantity in dict.fromkeys(known)
        if quantity.direction and not quantity.cost and quantity.key != verdict.quantity.key
    )
    return Answer(baseline, arm, verdict, others, tuple(m for m in metrics if m.pairs.rows))


def joined(comparisons: Sequence[Comparison]) -> Comparison:
    """The answers of several experiments as those of one, called ``A and B``.

    The experiment becomes a part of an arm's name: ``sfm-adc[experiment=A]``.
    """
    if len(comparisons) == 1:
        return comparisons[0]
    comparisons = [_with_place(one) for one in comparisons]
    experiments = [one.experiment for one in comparisons]
    both = replace(
        experiments[0],
        name=" and ".join(one.name for one in experiments),
        trials=tuple(itertools.chain(*(one.trials for one in experiments))),
        faults=tuple(itertools.chain(*(one.faults for one in experiments))),
        older=tuple(itertools.chain(*(one.older for one in experiments))),
        versions=tuple(itertools.chain(*(one.versions for one in experiments))),
    )
    trials = itertools.chain(*(one.trials for one in comparisons))
    answers = itertools.chain(*(one.answers for one in comparisons))
    return Comparison(both, tuple(trials), tuple(answers))


def _with_place(comparison: Comparison) -> Comparison:
    def arm(own: Arm) -> Arm:
        return replace(own, variant=(("experiment", comparison.experiment.name), *own.variant))

    def verdict(own: Verdict) -> Verdict:
        idea, baseline = arm(own.question.idea), arm(own.question.baseline)
        return replace(own, question=replace(own.question, idea=idea, baseline=baseline))

    answers = (
        Answer(
            arm(one.baseline),
            arm(one.arm),
            verdict(one.verdict),
            tuple(map(verdict, one.others)),
            tuple(map(verdict, one.metrics)),
            one.earlier,
        )
        for one in comparison.answers
    )
    trials = (replace(trial, variant=arm(trial.arm).variant) for trial in comparison.trials)
    return replace(comparison, trials=tuple(trials), answers=tuple(answers))


def chosen(comparison: Comparison, trials: Sequence[TrialResult], where: str) -> Comparison:
    """The answers about ``trials`` alone, which ``where`` chose among those of the comparison.

    An answer that lost none of its trials stays; any other is an interval, since the choice may
    have been made after seeing results. One without a pair of trials left goes.
    """
    kept = {trial.path for trial in trials}
    own = [trial for trial in comparison.trials if trial.path in kept]
    answers = []
    for answer in comparison.answers:
        used = {trial.path for trial in answer.verdict.pairs.trials}
        if used and used <= kept:
            answers.append(answer)
        elif {answer.baseline, answer.arm} <= {trial.arm for trial in own}:
            metric, why = answer.verdict.quantity.key, f"{where} chose its trials"
            verdict = interval_of(own, answer.baseline, answer.arm, metric, NOT_TESTED, why)
            answers.append(_with_metrics(verdict, own, answer.baseline, answer.arm))
    return replace(comparison, trials=tuple(own), answers=tuple(answers))


def winners(comparison: Comparison) -> dict[tuple[str, frozenset[str]], set[Arm]]:
    """The arms that were shown to be better, by metric and scenes.

    A baseline is one if all arms that are compared with it on these scenes are worse.
    """
    found: dict[tuple[str, frozenset[str]], tuple[set[Arm], set[Arm]]] = {}
    for answer in comparison.answers:
        verdict = answer.verdict
        place = verdict.quantity.key, frozenset(verdict.question.seeds)
        better, worse = found.setdefault(place, (set(), set()))
        sides = answer.baseline, answer.arm
        if verdict.state == ANSWERED and verdict.outcome in (SUPPORTED, REFUTED):
            if verdict.question.sign != verdict.quantity.direction:
                continue
            sides = sides if verdict.outcome == SUPPORTED else sides[::-1]
            worse.add(sides[0])
            better.add(sides[1])
        else:
            worse.update(sides)
    return {place: better - worse for place, (better, worse) in found.items()}


def same_bits_notes(trials: Sequence[TrialResult]) -> list[Note]:
    """A note on settings of one densifier that had no effect: all their results are equal."""
    results: dict[Arm, set[Hashable]] = {}
    for trial in trials:
        place = trial.experiment, trial.scene, trial.seed
        values = trial.record.num_gaussians, *sorted(trial.metrics.items())
        results.setdefault(trial.arm, set()).add((*place, *values))
    same = group_by(results, lambda arm: (arm.name, frozenset(results[arm])))
    return [Note.of("same bits", arms=arms) for arms in same.values() if len(arms) > 1]
