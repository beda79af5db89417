"""All answers of an experiment, made once: every verb, table and page shows these.

A `Comparison` has the trials that count, what was declared, the verdicts on each compared pair of
arms, and a line for each arm and trial that no verdict uses.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from gsbench.analysis.cells import with_variants
from gsbench.analysis.declaration import ActiveDeclaration, active_declaration
from gsbench.analysis.pairing import (
    BASELINE,
    baseline_settings,
    choose_pairs,
    controls_of,
    pair_trials,
    uncompared,
)
from gsbench.analysis.results import Arm, Experiment, TrialResult, group_by
from gsbench.analysis.verdicts import PairVerdicts, judge_pairs, sentence
from gsbench.runs.layout import LEDGER, TUNING
from gsbench.words import some_of

VERDICT = "Verdict, "  # prefix of the lines below a table that state verdicts


@dataclass(frozen=True)
class Pairing:
    """The arms of an experiment: ``trials`` with their variants, pairs, and arms without a pair.

    A search has no pairs: its points were chosen by results, so no test of them is valid.
    """

    trials: tuple[TrialResult, ...]
    pairs: tuple[tuple[Arm, Arm], ...]
    uncompared: tuple[str, ...]


def pair_arms(experiment: Experiment, baseline: str = BASELINE) -> Pairing:
    """Choose the pairs of arms to compare; every arm is in one, or in a line with its reason."""
    trials = tuple(with_variants(experiment.trials))
    if (experiment.folder / TUNING).exists():
        return Pairing(trials, (), ())
    by_arm = group_by(trials, lambda trial: trial.arm)
    arms, settings = sorted(by_arm), {arm: own[0].config for arm, own in by_arm.items()}
    ages = {arm: min(trial.measured for trial in own) for arm, own in by_arm.items()}
    pairs = choose_pairs(arms, baseline, controls_of(trials), settings, ages)
    pairs += [
        pair
        for pair in baseline_settings(arms, ages, baseline)
        # settings under which no two trials can be paired, such as budgets, give no verdict
        if pair not in pairs and pair_trials(trials, *pair)
    ]
    return Pairing(trials, tuple(pairs), tuple(uncompared(arms, pairs, baseline)))


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
        return [sentence(one) for one in self.answers]

    @cached_property
    def unused(self) -> list[str]:
        """A line with its reason for each arm and each trial that no verdict uses."""
        return [*self.arms.uncompared, *dict.fromkeys(self._unused_trials())]

    def _unused_trials(self) -> Iterator[str]:
        used = {
            trial.path
            for one in self.answers
            for verdict in one.verdicts
            for trial in verdict.pairs.trials
        }
        for arm, own in group_by(self.trials, lambda trial: trial.arm).items():
            left_out = [trial.label for trial in own if trial.path not in used]
            answers = [one for one in self.answers if arm in (one.first, one.second)]
            # Where an arm has no verdict at all, its sentence says why.
            if left_out and any(one.verdicts for one in answers):
                notes = [note for one in answers for own in one.verdicts for note in own.notes]
                reasons = some_of(list(dict.fromkeys(notes))) or NOT_PLANNED
                yield f"In no verdict: {some_of(left_out)} ({reasons})."

    @cached_property
    def declaration_lines(self) -> list[str]:
        """Sentences on what was declared, and how much of it is still to come."""
        if self.declared is None or not self.answers:
            return []
        metric = self.answers[0].declared
        name = self.declared.metric if metric is None else metric.name
        standings = [one.standing for one in self.answers if one.standing is not None]
        progress = self.declared.progress(self.trials)
        return [*self.declared.sentences(name, standings), *progress]

    def lines(self) -> list[str]:
        """The lines below a table: verdicts, what no verdict uses, and what was declared."""
        return [
            *(f"{VERDICT}{one}" for one in self.sentences),
            *self.unused,
            *self.declaration_lines,
        ]

    def to_json(self) -> dict[str, Any]:
        """The verdicts on each compared pair of arms and what is left out, for other programs."""
        left_out = [*self.unused, *self.experiment.warnings]
        return {"pairs": [_as_json(one) for one in self.answers], "left_out": left_out}


NOT_PLANNED = "seeds after an undeclared or missing one do not count"


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
            "tests": verdict.family,
            "trials": [trial.label for trial in verdict.pairs.trials],
        }
        for verdict in one.verdicts
    ]
    return {
        "arm": str(one.second),
        "baseline": str(one.first),
        "sentence": sentence(one),
        "verdicts": verdicts,
        "notes": list(one.notes),
    }


def compare(experiment: Experiment, baseline: str = BASELINE) -> Comparison:
    """Answer all questions of an experiment: each of its arms against ``baseline``."""
    arms = pair_arms(experiment, baseline)
    declared = active_declaration(experiment.folder, arms.trials, experiment.older)
    answers = judge_pairs(arms.trials, arms.pairs, declared, experiment.lacking)
    if (experiment.folder / LEDGER).exists():
        answers = [
            replace(one, undeclared=LEDGER_DECIDES.format(experiment.name)) for one in answers
        ]
    return Comparison(experiment, arms, declared, tuple(answers))


LEDGER_DECIDES = "the ledger's tests decide (gsbench ledger show {}), and this is none of them"
