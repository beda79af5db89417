"""Ends of trials, in words."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gsbench.errors import GsbenchError, InputError
from gsbench.runs.layout import LOG
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


def outcome_of_results(folder: Path, results: TrialRecord) -> Outcome:
    """The outcome of a complete trial."""
    return Outcome(folder, "done", results.metrics_line)


def outcome_of_error(folder: Path, error: Exception) -> Outcome:
    """The outcome of a trial that raised ``error``."""
    if isinstance(error, GsbenchError):
        return Outcome(folder, "failed", str(error), isinstance(error, InputError))
    text = f"{type(error).__name__}: {error}".splitlines()[0]
    return Outcome(folder, "failed", f"{text}; the traceback is in {folder / LOG}")
