"""All answers of an experiment, made once: every verb, table and page shows these.

A `Comparison` has the trials that count, what was declared, the verdicts on each compared pair of
arms, and a line for each arm and trial that no verdict uses.
"""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from gsbench.analysis.attempts import measured_elsewhere
from gsbench.analysis.cells import with_variants
from gsbench.analysis.declaration import ActiveDeclaration, active_declaration
from gsbench.analysis.judgement import Verdict
from gsbench.analysis.notes import Note, texts
from gsbench.analysis.pairing import (
    BASELINE,
    are_equal,
    baseline_settings,
    choose_pairs,
    controls_of,
    pair_trials,
    uncompared,
)
from gsbench.analysis.results import Arm, Experiment, TrialResult, group_by
from gsbench.analysis.unfinished import unfinished
from gsbench.analysis.verdict_words import sentence
from gsbench.analysis.verdicts import PairVerdicts, judge_pairs
from gsbench.runs.experiments import Question
from gsbench.runs.layout import LEDGER, TUNING
from gsbench.words import command

VERDICT = Note.of("verdict", sentence="").sentence  # begins the notes that state verdicts


@dataclass(frozen=True)
class Pairing:
    """The arms of an experiment: ``trials`` with their variants, pairs, and arms without a pair.

    A search has no pairs: its points were chosen by results, so no test of them is valid.
    """

    trials: tuple[TrialResult, ...]
    pairs: tuple[tuple[Arm, Arm], ...]
    uncompared: tuple[Note, ...]


def pair_arms(experiment: Experiment, baseline: str = BASELINE) -> Pairing:
    """Choose the pairs of arms to compare; every arm is in one, or in a note with its reason."""
    trials = tuple(with_variants(experiment.trials))
    if (experiment.folder / TUNING).exists():
        return Pairing(trials, (), ())
    by_arm = group_by(trials, lambda trial: trial.arm)
    arms, settings = sorted(by_arm), {arm: own[0].config for arm, own in by_arm.items()}
    ages = {arm: min(trial.measured for trial in own) for arm, own in by_arm.items()}
    # A sweep in looks declared its pairs before any trial began: its baseline stays the baseline,
    # and other pairs of its arms are none, since it stopped by the results of its own.
    planned = _pairs_in_looks(experiment)
    keys = {arm: {trial.key for trial in own} for arm, own in by_arm.items()}
    ages |= {arm: -math.inf for arm in arms if any(keys[arm] & first for first, _ in planned)}
    in_looks = {arm for arm in arms if any(keys[arm] & (one | two) for one, two in planned)}
    # The two arms may have no result on a common scene yet.
    declared = {
        (first, second)
        for one, two in planned
        for first in arms
        if keys[first] & one
        for second in arms
        if keys[second] & two and second != first
    }
    pairs = choose_pairs(arms, baseline, controls_of(trials), settings, ages)
    # with another baseline, a declared pair is not also asked the other way round
    pairs = [(one, two) for one, two in pairs if (two, one) not in declared]
    pairs += sorted(declared.difference(pairs))
    pairs += [
        (first, second)
        for first, second in baseline_settings(arms, ages, baseline)
        if (first, second) not in pairs
        # settings under which no two trials can be paired, such as budgets, give no verdict
        and pair_trials(trials, first, second)
        and not {first, second} <= in_looks
    ]
    return Pairing(trials, tuple(pairs), tuple(uncompared(arms, pairs, baseline)))


def _pairs_in_looks(experiment: Experiment) -> list[tuple[set[str], set[str]]]:
    """The questions of sweeps in looks: keys of the baseline's and of the arm's trials."""
    return [
        ({first for first, _ in both}, {second for _, second in both})
        for declaration in experiment.declarations
        if declaration.looks
        for both in (question.scenes.values() for question in declaration.questions)
    ]


@dataclass(frozen=True)
class Comparison:
    """The answers of an experiment; see the head of this file."""

    experiment: Experiment
    arms: Pairing
    declared: ActiveDeclaration | None
    answers: tuple[PairVerdicts, ...]

    @property
    def trials(self) -> tuple[TrialResult, ...]:
        return self.arms.trials

    @property
    def pairs(self) -> tuple[tuple[Arm, Arm], ...]:
        return self.arms.pairs

    @property
    def sentences(self) -> list[str]:
        """The verdict on each compared pair of arms, in one sentence each."""
        return [sentence(answer) for answer in self.answers]

    @cached_property
    def unused(self) -> list[Note]:
        """A note with the reason for each arm and each trial that no verdict uses."""
        verdicts = [verdict for answer in self.answers for verdict in answer.verdicts]
        # Where an arm has no verdict at all, its sentence says why.
        asked = {
            arm
            for answer in self.answers
            if answer.verdicts
            for arm in (answer.first, answer.second)
        }
        trials = [trial for trial in self.trials if trial.arm in asked]
        return [*self.arms.uncompared, *unused_trials(trials, verdicts), *self._apart]

    @property
    def _apart(self) -> list[Note]:
        """Notes on trials that some verdicts on their arm use, and others do not."""
        used = {
            (answer.first, answer.second): {
                trial.path for verdict in answer.verdicts for trial in verdict.pairs.trials
            }
            for answer in self.answers
            if answer.verdicts
        }
        anywhere = set().union(*used.values())
        apart: dict[tuple[Arm, tuple[str, ...]], list[Arm]] = {}
        for pair, own in used.items():
            beside = [
                trial for trial in self.trials if trial.arm in pair and trial.path in anywhere - own
            ]
            if beside:
                labels = tuple(trial.label for trial in beside)
                apart.setdefault((pair[0], labels), []).append(pair[1])
        return [
            Note.of("judged apart", arms=arms, baseline=first, trials=labels)
            for (first, labels), arms in apart.items()
        ]

    @cached_property
    def remarks(self) -> list[Note]:
        """Notes that belong to the sentences, wherever they stand.

        That is what no verdict uses, old code, code in other experiments, arms with the same bits,
        and declared trials that are missing.
        """
        lacking = [
            note
            for answer in self.answers
            for note in answer.notes
            if note.kind in ("no direction", "valueless")
        ]
        early = [note for note in self._progress if note.kind == "early look"]
        of_code = [*edited_notes(self.trials), *self._elsewhere, *same_bits_notes(self.trials)]
        return [*self.unused, *dict.fromkeys(lacking), *of_code, *early]

    @property
    def _elsewhere(self) -> list[Note]:
        """A note for each arm that other experiments measured by other code on its seeds."""
        by_arm = group_by(self.trials, lambda trial: trial.arm)
        compared = {second: by_arm[second] for _, second in self.pairs}
        found = measured_elsewhere(self.experiment.folder, compared)
        return [Note.of("elsewhere", arm=arm, experiments=own) for arm, own in found.items()]

    @cached_property
    def _progress(self) -> list[Note]:
        return self.declared.progress(self.trials) if self.declared and self.answers else []

    @cached_property
    def declared_notes(self) -> list[Note]:
        """Notes on what was declared, and on looks to come."""
        if self.declared is None or not self.answers:
            return []
        notes, in_force = [], group_by(self.answers, lambda one: one.declared)
        for metric, own in in_force.items():
            if metric is not None and own[0].standing is not None:
                doubted = any(not answer.beforehand for answer in own)
                notes += own[0].standing.active.notes(metric.name, doubted)
        known = [answer.standing.active.records for answer in self.answers if answer.standing]
        unused = [
            declaration
            for declaration in self.declared.declared
            if declaration not in itertools.chain(*known)
        ]
        notes += [
            Note.of("replaced", metric=replaced.primary, when=replaced.when) for replaced in unused
        ]
        return [*notes, *(note for note in self._progress if note.kind == "looks to come")]

    def notes(self) -> list[Note]:
        """The notes below a table: verdicts, remarks, and what was declared."""
        return [
            *(Note.of("verdict", sentence=text) for text in self.sentences),
            *self.remarks,
            *self.declared_notes,
        ]

    def to_json(self) -> dict[str, Any]:
        """The verdicts on each compared pair of arms and what is left out, for other programs."""
        left_out = texts([*self.remarks, *self.experiment.warnings])
        return {"pairs": [_as_json(answer) for answer in self.answers], "left_out": left_out}


def edited_notes(trials: Sequence[TrialResult]) -> list[Note]:
    """A note for each of the user's modules that was edited after it made some of the trials."""
    of_module: dict[str, list[TrialResult]] = {}
    # Trials of one version of the code have the same edits, and finding them reads the modules.
    for own in group_by(trials, lambda trial: frozenset(trial.code.items())).values():
        for edit in own[0].edits:
            of_module.setdefault(edit.name, []).extend(own)
    return [
        Note.of(
            "edited",
            module=module,
            trials=len(own),
            arms=sorted({f"{trial.init}-{trial.densify}" for trial in own}),
        )
        for module, own in of_module.items()
    ]


def same_bits_notes(trials: Sequence[TrialResult]) -> list[Note]:
    """A note on settings of one densifier that had no effect: all their results are equal."""
    places: dict[Arm, dict[tuple[str, int], TrialResult]] = {}
    for trial in trials:
        places.setdefault(trial.arm, {})[trial.scene, trial.seed] = trial
    equal: dict[Arm, list[Arm]] = {}
    for one, two in itertools.combinations(places, 2):
        both = places[one].keys() & places[two].keys()
        same = (one.init, one.densify) == (two.init, two.densify) and both
        known = itertools.chain(*equal.values())
        if (
            same
            and one not in known
            and all(are_equal(places[one][place], places[two][place]) for place in both)
        ):
            equal.setdefault(one, [one]).append(two)
    return [Note.of("same bits", arms=own) for own in equal.values()]


def unused_trials(trials: Sequence[TrialResult], verdicts: Sequence[Verdict]) -> list[Note]:
    """A note with the reasons for the trials of each arm that are in none of ``verdicts``."""
    used = {trial.path for verdict in verdicts for trial in verdict.pairs.trials}
    left_out = [trial for trial in trials if trial.path not in used]
    found = []
    for own in group_by(left_out, lambda trial: trial.arm).values():
        asked = [
            verdict for verdict in verdicts if any(_asks(verdict.question, trial) for trial in own)
        ]
        scenes = {trial.scene for trial in own}
        reasons = [reason for verdict in asked for reason in _reasons(verdict, scenes)]
        if not reasons:
            reasons = [Note.of("not planned" if asked else "not asked").sentence]
        labels = [trial.label for trial in own]
        found.append(Note.of("unused", trials=labels, reasons=list(dict.fromkeys(reasons))))
    return found


def _asks(question: Question, trial: TrialResult) -> bool:
    """Return whether a question is about a trial."""
    if question.scenes:
        return any(trial.key in keys for keys in question.scenes.values())
    return trial.arm in (question.baseline, question.arm)


def _reasons(verdict: Verdict, scenes: Collection[str]) -> list[str]:
    """The reasons why a verdict leaves trials of its question on these scenes out."""
    notes = [note for note in (verdict.untestable, *verdict.notes) if note]
    reasons = [note.sentence for note in notes if dict(note.facts).get("scene") in (None, *scenes)]
    if verdict.question.seeds and verdict.answer is not None and verdict.final:
        reasons.append(Note.of("decided before", seeds=verdict.pairs.seeds).sentence)
    if not reasons and verdict.question.seeds and verdict.answer is None:
        reasons.append(Note.of("waits").sentence)
    return reasons


def _as_json(one: PairVerdicts) -> dict[str, Any]:
    verdicts: Sequence[Mapping[str, Any]] = [
        {
            "metric": verdict.question.metric,
            "role": one.role(verdict) or "exploratory",
            "outcome": verdict.outcome,
            "difference": verdict.mean,
            "interval": None
            if verdict.interval is None
            else [verdict.interval.low, verdict.interval.high],
            "p": verdict.p,
            "error_rate": None if verdict.answer is None else verdict.answer.level,
            "tests": verdict.family,
            "trials": [trial.label for trial in verdict.pairs.trials],
        }
        for verdict in one.verdicts
    ]
    return {
        "arm": str(one.second),
        "baseline": str(one.first),
        "sentence": sentence(one),
        "versions": one.versions,
        "verdicts": verdicts,
        "notes": texts(one.notes),
    }


def compare(experiment: Experiment, baseline: str = BASELINE) -> Comparison:
    """Answer all questions of an experiment: each of its arms against ``baseline``."""
    arms = pair_arms(experiment, baseline)
    declared = active_declaration(experiment)
    usual = arms if baseline == BASELINE else pair_arms(experiment)
    shown, known = ({frozenset(pair) for pair in one.pairs} for one in (arms, usual))
    others = [pair for pair in arms.pairs if frozenset(pair) not in known]
    turned = {(second, first) for first, second in usual.pairs}.difference(usual.pairs)
    # A baseline that is chosen later frees no question of the others' share of the error rate.
    pairs = [*arms.pairs, *(pair for pair in usual.pairs if frozenset(pair) not in shown)]
    lacking, past = unfinished(experiment), (experiment.older, experiment.seen)
    if declared is not None:
        lacking += declared.missing(arms.trials)
    answers = judge_pairs(arms.trials, pairs, declared, lacking, others, *past, turned)
    answers = answers[: len(arms.pairs)]
    if (experiment.folder / LEDGER).exists():
        answers = [
            replace(
                answer,
                undeclared=LEDGER_DECIDES.format(command("ledger", "show", experiment.name)),
            )
            for answer in answers
        ]
    elif any(one.kind == "claims" and one.looks for one in experiment.declarations):
        answers = [replace(one, undeclared=CLAIMS_DECIDE) for one in answers]
    return Comparison(experiment, arms, declared, tuple(answers))


CLAIMS_DECIDE = "declared claims decide (gsbench check), and seeds came in looks until they did"
LEDGER_DECIDES = "the ledger's tests decide ({}), and this is none of them"
