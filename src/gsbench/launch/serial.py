"""Running trials one after the other in this process, and the outcome of a trial as picklable values."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gsbench.config.compose import Trial
from gsbench.errors import GsbenchError, InputError
from gsbench.files import DiskFullError
from gsbench.runs.layout import LOG
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import TrialRecord
from gsbench.system.locks import BusyError
from gsbench.tracking import Mirror

log = logging.getLogger(__name__)

Status = Literal["done", "failed", "queued"]


@dataclass(frozen=True)
class Outcome:
    """The end of a trial: ``message`` has its metrics, or why it failed.

    ``bad_input`` says that the user's files or settings are the cause. A "queued" trial was left to Slurm, in the job
    that ``message`` names; it may be running by now.
    """

    folder: Path
    status: Status
    message: str = ""
    bad_input: bool = False

    @property
    def label(self) -> str:
        return TrialFolder(self.folder).label


def outcome_of_results(folder: Path, results: TrialRecord) -> Outcome:
    """The outcome of a complete trial."""
    metrics = "  ".join(f"{key} {value:.4g}" for key, value in results.metrics.items())
    return Outcome(folder, "done", metrics)


def outcome_of_error(folder: Path, error: Exception) -> Outcome:
    """The outcome of a trial that raised ``error``."""
    if isinstance(error, GsbenchError):
        return Outcome(folder, "failed", str(error), isinstance(error, InputError))
    text = f"{type(error).__name__}: {error}".splitlines()[0]
    return Outcome(folder, "failed", f"{text}; the traceback is in {folder / LOG}")


def run_serial(trials: Sequence[Trial], mirror: Mirror) -> list[Outcome]:
    """Run the trials. A trial that another process is running comes last, so that two sweeps share the work."""
    outcomes: list[Outcome] = []
    busy: list[Trial] = []
    for number, trial in enumerate(trials, 1):
        if len(trials) > 1:
            log.info("%d of %d: %s", number, len(trials), trial.files.label)
        try:
            outcomes.append(run_one(trial, mirror, wait=len(trials) == 1))
        except BusyError as error:
            log.info("%s; later", error)
            busy.append(trial)
    return outcomes + [run_one(trial, mirror, wait=True) for trial in busy]


def run_one(trial: Trial, mirror: Mirror, wait: bool) -> Outcome:
    """Run and mirror one trial.

    Errors become its outcome, except BusyError, DiskFullError, and exceptions that end the program.
    """
    mirror.follow(trial.folder, trial.values["tracking"])
    try:
        from gsbench.pipeline.trial import run_trial  # here, because a sweep that is done needs no torch

        return outcome_of_results(trial.folder, run_trial(trial, wait))
    except (BusyError, DiskFullError):
        raise
    except Exception as error:  # noqa: BLE001 - a failed trial does not stop the others
        return outcome_of_error(trial.folder, error)
