"""Trials without a usable result, and the verdicts that they forbid.

An arm whose bad trainings fail looks better than it is, since only the good ones are compared. So
no verdict favours an arm that lacks a result where the other arm has one.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from gsbench.analysis.results import Experiment, TrialResult
from gsbench.analysis.trial_settings import config_if_readable
from gsbench.runs.experiments import Question, trial_key
from gsbench.runs.layout import SEED
from gsbench.words import counted, some_of

BASELINE, ARM = 0, 1  # the sides of a question


@dataclass(frozen=True)
class Unfinished:
    """The folder of a trial that failed, was stopped, is damaged or gone, or lacks the metric.

    ``known`` are its settings if they need not be read.
    """

    path: Path
    known: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)

    @property
    def scene(self) -> str:
        return self.path.parts[-3]

    @property
    def seed(self) -> int:
        return int(self.path.name.partition(SEED)[2])

    @property
    def key(self) -> str:
        return trial_key(self.scene, self.path.parts[-2], self.path.name.partition(SEED)[0])

    @property
    def label(self) -> str:
        return "/".join(self.path.parts[-4:])

    @cached_property
    def config(self) -> Mapping[str, Any]:
        """The settings with dotted keys; empty if unreadable."""
        return self.known or config_if_readable(self.path)

    def is_of(self, question: Question, side: int) -> bool:
        """Return whether the trial belongs to a side of the question."""
        if question.seeds and self.seed not in question.seeds:
            return False
        if question.scenes:
            return self.key == question.scenes.get(self.scene, ("", ""))[side]
        arm = (question.baseline, question.arm)[side]
        # without readable settings it may be of any arm of that name
        return arm is not None and arm.has(self.path.parts[-2], self.config or dict(arm.variant))


def unfinished(experiment: Experiment) -> list[Unfinished]:
    """The trials of an experiment without a usable result."""
    return [Unfinished(path) for path in experiment.lacking]


def one_sided(
    question: Question, trials: Iterable[TrialResult], lacking: Iterable[Unfinished]
) -> tuple[Sequence[Unfinished], Sequence[Unfinished]]:
    """The trials of each side of a question that lack a result where the other side has one.

    ``trials`` are both sides' finished trials. A side lacks nothing where another trial of it has
    finished, as after a repair of its code.
    """
    done: tuple[set[tuple[str, int]], set[tuple[str, int]]] = (set(), set())
    of_arm = {arm for _, arm in question.scenes.values()}
    for trial in trials:
        is_arm = trial.key in of_arm if question.scenes else trial.arm == question.arm
        done[ARM if is_arm else BASELINE].add((trial.scene, trial.seed))
    found: tuple[list[Unfinished], list[Unfinished]] = ([], [])
    for one in dict.fromkeys(lacking):
        for side in (BASELINE, ARM):
            if (one.scene, one.seed) in done[1 - side] - done[side] and one.is_of(question, side):
                found[side].append(one)
    return found


def lacking_words(lacking: Sequence[Unfinished]) -> str:
    """The reason why a verdict that would favour an arm with such trials is undecided."""
    return (
        f"{counted(len(lacking), 'trial')} of one arm alone failed, stopped, went missing or gave "
        f"no value, perhaps its bad ones: {some_of([trial.label for trial in lacking])}"
    )
