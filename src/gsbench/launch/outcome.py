"""End of a trial, as plain values that travel between processes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gsbench.errors import GsbenchError, InputError
from gsbench.files import DiskFullError
from gsbench.runs.layout import LOG
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import TrialRecord

Status = Literal["done", "failed", "queued"]


@dataclass(frozen=True)
class Outcome:
    """``message`` is why a trial failed, or its metrics; ``bad_input``: the user's files or settings are the cause.

    One that is queued was left to Slurm, in the job that ``message`` names, and may be running by now.
    """

    folder: Path
    status: Status
    message: str = ""
    bad_input: bool = False
    fatal: bool = False  # no other trial can succeed either

    @property
    def label(self) -> str:
        return TrialFolder(self.folder).label


def outcome_of_results(folder: Path, results: TrialRecord) -> Outcome:
    """The outcome of a trial that is complete."""
    metrics = "  ".join(f"{key} {value:.4g}" for key, value in results.metrics.items())
    return Outcome(folder, "done", metrics)


def outcome_of_error(folder: Path, error: Exception) -> Outcome:
    """The outcome of a trial that raised ``error``."""
    if isinstance(error, GsbenchError):
        return Outcome(folder, "failed", str(error), isinstance(error, InputError), isinstance(error, DiskFullError))
    text = f"{type(error).__name__}: {error}".splitlines()[0]
    return Outcome(folder, "failed", f"{text}; the traceback is in {folder / LOG}")
