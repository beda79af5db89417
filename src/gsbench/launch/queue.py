"""Jobs that Slurm was given, by notes in trials' folders, and those that it still has, by its queue. Loads no torch."""

from __future__ import annotations

import getpass
import os
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from gsbench.files import write_json
from gsbench.records import Record, read_if_sound
from gsbench.runs.layout import SUBMITTED

SECONDS_TO_ANSWER = 60.0
WAITING = ("PENDING", "CONFIGURING", "REQUEUED", "REQUEUE_HOLD", "REQUEUE_FED", "RESV_DEL_HOLD", "SPECIAL_EXIT")


@dataclass(frozen=True, kw_only=True)
class Submission(Record):
    """``.submitted.json``: the job that a trial was given to, its log, whose job it is."""

    job: Annotated[str, Field(pattern=r"^[\w.\[\]%-]+$")]
    log: str = "unknown"
    user: Annotated[str, Field(pattern=r"^[\w.@\\+-]*$")] = ""


@dataclass(frozen=True)
class QueuedJob:
    """A job or array task in the queue: its state in Slurm's words, and why it waits."""

    state: str
    reason: str

    @property
    def waits(self) -> bool:
        """Return whether the job has not begun, or not begun again."""
        return self.state in WAITING

    @property
    def words(self) -> str:
        """The state for people: ``pending (Resources)``."""
        return self.state.lower() + (f" ({self.reason})" if self.reason not in ("", "None") else "")


Queue = Mapping[str, QueuedJob]


def record_submission(folder: Path, job: str, log: Path) -> None:
    """Note in the trial's ``folder`` that Slurm was given it as ``job``."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / SUBMITTED, Submission(job=job, log=str(log), user=current_user()).to_json())


def read_submission(folder: Path) -> Submission | None:
    """The job that was last given the trial in ``folder``; None if there is none, or it has ended by itself."""
    return read_if_sound(folder / SUBMITTED, Submission)


def forget_submission(folder: Path) -> None:
    """Record that the job of the trial in ``folder`` has ended."""
    (folder / SUBMITTED).unlink(missing_ok=True)


def ask_queue(folders: Iterable[Path]) -> Queue | None:
    """The queue, of those users whose jobs were given trials in ``folders``; None where Slurm does not answer."""
    submissions = [found for folder in folders if (found := read_submission(folder))]
    return read_queue({submission.user or current_user() for submission in submissions}) if submissions else {}


def state_in_queue(folder: Path, queue: Queue | None) -> Literal["queued", "running"] | None:
    """The state of a trial that no process holds and that is not done, if Slurm has it; else None.

    Where Slurm does not answer (``queue`` is None), it is believed to have what it was given.
    """
    submission = read_submission(folder)
    if submission is None or (queue is not None and submission.job not in queue):
        return None
    return "queued" if queue is None or queue[submission.job].waits else "running"


def read_queue(users: Iterable[str]) -> Queue | None:
    """The jobs and array tasks of ``users`` by id; None where there is no Slurm, or it does not answer."""
    command = ["squeue", f"--user={','.join(sorted(users))}", "--noheader", "--array", "--format=%i|%T|%r"]
    try:
        listing = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS_TO_ANSWER, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    lines = [line.split("|") for line in listing.stdout.splitlines() if line.count("|") == 2]
    return {job: QueuedJob(state, reason) for job, state, reason in lines}


def current_user() -> str:
    """The user's name; the number where the system knows no name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container's nameless user
        return str(os.getuid())
