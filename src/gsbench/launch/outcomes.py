"""Ends of trials, in words, and failures that other trials of a sweep would repeat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from gsbench.config.compose import Trial
from gsbench.errors import GsbenchError, InputError
from gsbench.runs.layout import LOG
from gsbench.runs.nested import flatten
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import TrialRecord

Status = Literal["done", "failed", "queued"]


@dataclass(frozen=True)
class Outcome:
    """The end of a trial: ``message`` has its metrics, or why it failed.

    ``bad_input`` says that the user's files or settings are the cause. A "queued" trial was left to
    Slurm, in the job that ``message`` names; it may be running by now. With ``change`` the trial
    was not started, since it would fail as another one did: this setting must change first.
    """

    folder: Path
    status: Status
    message: str = ""
    bad_input: bool = False
    change: str = ""

    @property
    def label(self) -> str:
        return TrialFolder(self.folder).label

    @property
    def error(self) -> GsbenchError:
        """The error of a failed trial."""
        return (InputError if self.bad_input else GsbenchError)(self.message)


def outcome_of_results(folder: Path, results: TrialRecord) -> Outcome:
    """The outcome of a complete trial."""
    return Outcome(folder, "done", results.metrics_line)


def outcome_of_error(folder: Path, error: Exception) -> Outcome:
    """The outcome of a trial that raised ``error``."""
    if isinstance(error, GsbenchError):
        return Outcome(folder, "failed", str(error), isinstance(error, InputError))
    text = f"{type(error).__name__}: {error}".splitlines()[0]
    return Outcome(folder, "failed", f"{text}; the traceback is in {folder / LOG}")


# ---- failures that other trials would repeat, so that these are not started

SCENE = ("scene",)
CLOUD = (*SCENE, "init")
ALL = (*CLOUD, "densify", "raster", "train", "eval", "device")
# the settings that a stage reads; in other stages, any setting may be the cause
READ_BY = {"scene": SCENE, "ground_truth": SCENE, "init": CLOUD}
PARTS = ("densify", "raster", "train", "eval")


@dataclass
class Repeats:
    """The failures so far in a sweep that no other seed would avert.

    These are wrong settings and files, and errors before the first iteration.
    """

    _known: list[tuple[tuple[str, ...], dict[str, Any], Outcome]] = field(default_factory=list)

    def note(self, trial: Trial, outcome: Outcome) -> None:
        """Remember how a trial ended."""
        if outcome.status != "failed" or outcome.change or not trial.files.has_failed():
            return
        stage, step = trial.files.stage_and_step()
        if not outcome.bad_input and step > 0:
            return
        named = setting_in(outcome.message, trial.values)
        group = named.partition(".")[0]
        read = (group,) if outcome.bad_input and group in ALL else READ_BY.get(stage, ALL)
        change = named or f"a setting of {' or '.join(READ_BY.get(stage, PARTS))}"
        self._known.append((read, _values(trial, read), replace(outcome, change=change)))

    def of(self, trial: Trial) -> Outcome | None:
        """The failure that a ``trial`` would repeat, as its own; None if there is none."""
        same = (one for read, values, one in self._known if _values(trial, read) == values)
        found = next(same, None)
        return found and replace(found, folder=trial.folder)


def setting_in(message: str, values: dict[str, Any]) -> str:
    """The first setting that a message names; "" if it names none."""
    found = [key for key in flatten(values) if "." in key and key in message]
    # densify.split and densify.split_size may begin at one place: the longer one is meant
    return min(found, key=lambda key: (message.find(key), -len(key)), default="")


def _values(trial: Trial, read: Sequence[str]) -> dict[str, Any]:
    """The settings of a trial in the groups ``read``, without the names of choices."""
    return {
        key: value
        for key, value in flatten(trial.values).items()
        if (group := key.partition(".")[0]) in read and key != f"{group}.name"
    }
