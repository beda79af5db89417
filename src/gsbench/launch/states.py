"""The state of an experiment's trials: from their folders, and of those that Slurm was given also from its queue.

A note in a trial's folder says which job it was given to. Loads no torch.
"""

from __future__ import annotations

import getpass
import os
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from gsbench.errors import InputError
from gsbench.files import write_json
from gsbench.launch.record import read_plan
from gsbench.parsing import DamagedError
from gsbench.records import Record, read_if_sound
from gsbench.runs.experiments import trial_folders
from gsbench.runs.keys import determining_settings
from gsbench.runs.layout import CONFIG, FAILED, LOCK, RESULTS, SEED, SUBMITTED
from gsbench.runs.trial_folder import State, TrialFolder
from gsbench.system.locks import read_holder


@dataclass(frozen=True)
class TrialState:
    """A trial's state with what people want to know of it: since when (Unix time), and a note.

    A trial is ``queued`` where Slurm has it and it has not begun. One that is done is ``superseded`` where the code
    that made it is no longer the present one, one that failed where later code has taken its place.
    """

    folder: Path
    state: State | Literal["queued", "superseded"]
    since: float | None
    note: str

    @property
    def label(self) -> str:
        """Scene, arm and seed, for people."""
        return TrialFolder(self.folder).label


def states_of_experiment(home: Path) -> list[TrialState]:
    """The state of every trial of the experiment in ``home``, planned or found there."""
    planned = {folder: trial.time for folder, trial in read_plan(home).items()}
    found = {path for path in map(Path, trial_folders(home)) if SEED in path.name and (path / CONFIG).exists()}
    folders = sorted({*planned, *found})
    queue = ask_queue(folders)
    return _without_mended([_state(folder, planned.get(folder), queue) for folder in folders])


def _without_mended(trials: Sequence[TrialState]) -> list[TrialState]:
    """The states; a trial that failed or stopped is superseded where one of the same settings has got further.

    Such trials differ in a user's class alone, which was mended meanwhile.
    """
    others: dict[tuple[Path, str], list[TrialState]] = {}
    for trial in trials:
        if trial.state in ("done", "running", "queued"):
            others.setdefault(_twins(trial.folder), []).append(trial)
    return [
        replace(
            trial, state="superseded", note=f"{found.folder.name} is {found.state}, made by later code: {trial.note}"
        )
        if trial.state in ("failed", "partial")
        and (found := _same_settings(trial.folder, others.get(_twins(trial.folder), [])))
        else trial
        for trial in trials
    ]


def _twins(folder: Path) -> tuple[Path, str]:
    """Folder and end of the name that trials of one arm and seed share."""
    return folder.parent, folder.name.partition("-")[2]


def _same_settings(folder: Path, others: Sequence[TrialState]) -> TrialState | None:
    """The one of ``others`` whose configuration is that of the trial in ``folder``."""
    if not others or (own := _settings(folder)) is None:
        return None
    return next((other for other in others if _settings(other.folder) == own), None)


def _settings(folder: Path) -> dict[str, Any] | None:
    try:
        return determining_settings(TrialFolder(folder).configuration())
    except InputError:
        return None


def _state(folder: Path, planned: float | None, queue: Queue | None) -> TrialState:
    """The state of the trial in ``folder``; ``planned`` is when it was asked for."""
    state = TrialFolder(folder).state()
    if state == "done":
        return TrialState(folder, state, _changed(folder / RESULTS), "")
    if state == "running":
        holder = read_holder(folder / LOCK)
        since, where = (None, "process ? on ?") if holder is None else (holder.since, holder.description)
        return TrialState(folder, state, since, f"{_reached(folder)} {where}".strip())
    if state == "damaged":
        return TrialState(folder, state, _changed(folder / RESULTS), _damage(folder))
    submission = read_submission(folder)
    lost = ""
    if submission:
        if found := state_in_queue(folder, queue):
            job = queue.get(submission.job) if queue is not None else None
            words = job.words if job else "Slurm does not answer"
            note = f"{_reached(folder)} Slurm job {submission.job}, {words}".strip()
            return TrialState(folder, found, _changed(folder / SUBMITTED), note)
        lost = f"; Slurm job {submission.job} has ended, log: {submission.log}"
    if state == "failed":
        return TrialState(folder, state, _changed(folder / FAILED), TrialFolder(folder).failure().reason)
    if state == "partial":
        return TrialState(folder, state, _changed(folder / CONFIG), f"stopped {_reached(folder)}".strip() + lost)
    return TrialState(folder, state, planned, "never started" + lost)


def _damage(folder: Path) -> str:
    try:
        TrialFolder(folder).record()
    except (FileNotFoundError, DamagedError) as error:
        return f"{error.path.name} {error.reason}" if isinstance(error, DamagedError) else ""
    return ""


def _reached(folder: Path) -> str:
    stage, step = TrialFolder(folder).stage_and_step()
    return f"in {stage}" + (f" at iteration {step}" if stage == "train" and step else "") if stage else ""


def _changed(path: Path) -> float | None:
    try:
        return path.stat().st_mtime
    except OSError:
        return None


# ---- Slurm's queue

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
