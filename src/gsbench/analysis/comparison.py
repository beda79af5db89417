"""All answers of an experiment, made once: every verb, table and page shows these.

An idea has a row. Its verdict is that of its last answered question about the present code; its
other questions stand below, and so do other metrics, which are not tested. What nobody asked
beforehand has a mean and an interval.
"""

import itertools
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from gsbench.analysis.cells import with_variants
from gsbench.analysis.notes import Note, texts
from gsbench.analysis.pairs import BASELINE
from gsbench.analysis.quantities import choose_quantities
from gsbench.analysis.questions import Asked, choose_pairs
from gsbench.analysis.results import Arm, Experiment, TrialResult, group_by, trials_of
from gsbench.analysis.sentences import asked_words, badge, headline, risk, sentence
from gsbench.analysis.verdicts import State, Verdict, interval_of, judge
from gsbench.runs.commands import Question, code_in
from gsbench.runs.experiments import DEFAULT_METRIC
from gsbench.runs.layout import DECLARED, LEDGER, TUNING

# why nothing is tested where an earlier gsbench wrote what was asked, which is not read
EARLIER = {
    DECLARED: "an earlier gsbench wrote down what was asked",
    LEDGER: "the ledger of an earlier gsbench decided",
}


@dataclass(frozen=True)
class Answer:
    """Verdicts on an idea against a baseline.

    ``verdict`` is that of the last answered question about the present code; else of the last
    question, or an interval that nobody asked for. ``others`` are the verdicts on its other
    questions, the newest first; ``metrics`` the intervals of all other metrics. ``earlier``: it is
    about trials of code that was edited since.
    """

    verdict: Verdict
    others: tuple[Verdict, ...] = ()
    metrics: tuple[Verdict, ...] = ()
    earlier: bool = False

    @property
    def baseline(self) -> Arm:
        return self.verdict.question.baseline

    @property
    def arm(self) -> Arm:
        return self.verdict.question.idea

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
    answers: tuple[Answer, ...] = ()

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
        return risk([one for one in verdicts if one.state == "answered"])

    @cached_property
    def remarks(self) -> list[Note]:
        """Notes that belong to the sentences, wherever they stand."""
        compared = {arm for one in self.answers for arm in (one.baseline, one.arm)}
        by_arm = group_by(self.trials, "arm")
        alone = [arm for arm in by_arm if arm not in compared]
        notes = [Note.of("no partner", arm=arm) for arm in alone if self.answers or len(alone) > 1]
        for answer in self.answers:
            used = {trial.path for trial in answer.verdict.pairs.trials}
            # the baseline may have more seeds and scenes: they cost nothing
            unused = [one.label for one in by_arm.get(answer.arm, []) if one.path not in used]
            if unused and answer.verdict.state == "answered":
                notes.append(Note.of("unused", trials=unused, arm=answer.arm))
            notes += [note for note in answer.verdict.notes if note.kind == "valueless"]
        return [*notes, *same_bits_notes(self.trials)]

    def to_json(self) -> dict[str, Any]:
        """The verdicts and what is left out, for other programs."""
        answers = [
            {
                "arm": str(answer.arm),
                "baseline": str(answer.baseline),
                "badge": answer.badge,
                "sentence": answer.sentence,
                "notes": texts(answer.verdict.notes),
                "verdicts": [
                    _as_json(one) for one in (answer.verdict, *answer.others, *answer.metrics)
                ],
            }
            for answer in self.answers
        ]
        left_out = texts([*self.remarks, *self.experiment.warnings])
        return {"answers": answers, "risk": self.risk, "left_out": left_out}


def _as_json(verdict: Verdict) -> dict[str, Any]:
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
        return Comparison(experiment, trials)
    asked = [] if baseline else _asked(experiment, trials)
    terms = Asked(metric=DEFAULT_METRIC, baseline=baseline or BASELINE)
    known, ideas = {trial.arm for trial in trials}, {answer.arm for answer in asked}
    turned = {(answer.arm, answer.baseline) for answer in asked}
    unasked = [
        pair
        for pair in choose_pairs(trials, terms)
        if pair[1] not in ideas and pair not in turned and known.issuperset(pair)
    ]
    state: State = "not tested" if baseline else "not asked beforehand"
    why = ""
    for name, words in EARLIER.items():
        if (experiment.folder / name).exists():
            state, why = "not tested", f"{words} ({name})"
    # Grouped once: thousands of trials may have a hundred pairs of arms.
    by_arm, answers = group_by(trials, "arm"), [*asked]
    for pair in unasked:
        own = [trial for arm in pair for trial in by_arm[arm]]
        interval = interval_of(own, *pair, DEFAULT_METRIC, state, why)
        answers.append(_with_metrics(interval, own))
    return Comparison(experiment, trials, tuple(answers))


def _asked(experiment: Experiment, trials: Sequence[TrialResult]) -> list[Answer]:
    """The answers on what was asked; questions that an experiment's file names have one each."""
    everything = [*trials, *experiment.older]
    arms = {(trial.scene, trial.digest): trial.arm for trial in trials}
    verdicts = []
    for question in experiment.history.questions:
        # with the names that its arms have among all trials
        sides = []
        for side, name in enumerate((question.baseline, question.idea)):
            found = (arms.get((scene, both[side])) for scene, both in question.digests.items())
            sides.append(next(filter(None, found), name))
        question = replace(question, baseline=sides[0], idea=sides[1])
        verdicts.append(judge(everything, question, experiment.unfinished))
    folded = {trial.path for trial in experiment.older}
    answers = []
    for own in group_by(verdicts, "question.baseline", "question.idea", "question.name").values():
        code = _code_of(own[-1].question)
        current = [one for one in own if _code_of(one.question) == code]
        shown = ([one for one in current if one.state == "answered"] or current)[-1]
        others = tuple(one for one in reversed(own) if one is not shown)
        earlier = any(trial.path in folded for trial in shown.pairs.trials)
        answers.append(replace(_with_metrics(shown, trials, others), earlier=earlier))
    return sorted(answers, key=lambda answer: answer.earlier)


def _code_of(question: Question) -> set[str]:
    return {code_in(second) for _, second in question.digests.values()}


def _with_metrics(
    verdict: Verdict, trials: Sequence[TrialResult], others: tuple[Verdict, ...] = ()
) -> Answer:
    pair = verdict.question.baseline, verdict.question.idea
    own = trials_of(trials, *pair)
    known = [*(choose_quantities(own) if own else ()), *(one.quantity for one in others)]
    metrics = (
        interval_of(own, *pair, quantity.key)
        for quantity in dict.fromkeys(known)
        if quantity.direction and not quantity.cost and quantity.key != verdict.quantity.key
    )
    return Answer(verdict, others, tuple(one for one in metrics if one.pairs.rows))


def chosen(comparison: Comparison, trials: Sequence[TrialResult], where: str) -> Comparison:
    """The answers about ``trials`` alone, which ``where`` chose among those of the comparison.

    An answer that lost none of its trials stays; any other is an interval, since the choice may
    have been made after seeing results. One without a pair of trials left goes.
    """
    kept = {trial.path for trial in trials}
    own = tuple(trial for trial in comparison.trials if trial.path in kept)
    answers = []
    for answer in comparison.answers:
        used = {trial.path for trial in answer.verdict.pairs.trials}
        pair = answer.baseline, answer.arm
        if used and used <= kept:
            answers.append(answer)
        elif {trial.arm for trial in own}.issuperset(pair):
            metric, why = answer.verdict.quantity.key, f"{where} chose its trials"
            verdict = interval_of(own, *pair, metric, "not tested", why)
            answers.append(_with_metrics(verdict, own))
    return replace(comparison, trials=own, answers=tuple(answers))


def winners(comparison: Comparison) -> dict[tuple[str, frozenset[str]], set[Arm]]:
    """The arms that were shown to be better, by metric and scenes.

    A baseline is one if all arms that are compared with it on these scenes are worse.
    """
    found: dict[tuple[str, frozenset[str]], tuple[set[Arm], set[Arm]]] = {}
    for answer in comparison.answers:
        verdict, question = answer.verdict, answer.verdict.question
        place = verdict.quantity.key, frozenset(question.seeds)
        better, others = found.setdefault(place, (set(), set()))
        if verdict.state != "answered" or verdict.outcome not in ("supported", "refuted"):
            others.update((answer.baseline, answer.arm))
        elif question.sign == verdict.quantity.direction:
            sides = answer.baseline, answer.arm
            better.add(sides[verdict.outcome == "supported"])
            others.add(sides[verdict.outcome == "refuted"])
    return {place: better - others for place, (better, others) in found.items()}


def same_bits_notes(trials: Sequence[TrialResult]) -> list[Note]:
    """A note on settings of one densifier that had no effect: all their results are equal."""
    results: dict[Arm, set[Hashable]] = {}
    for trial in trials:
        place = trial.experiment, trial.scene, trial.seed
        values = trial.record.num_gaussians, *sorted(trial.metrics.items())
        results.setdefault(trial.arm, set()).add((*place, *values))
    same = group_by(results, lambda arm: (arm.name, frozenset(results[arm])))
    return [Note.of("same bits", arms=arms) for arms in same.values() if len(arms) > 1]
