"""The states of trials, from their folders and from Slurm's queue, and the names of their arms.

A file in a trial's folder names its Slurm job. Loads no torch.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import psutil
from pydantic import Field

from gsbench.analysis.results import group_by, newest_code, read_experiment
from gsbench.errors import InputError
from gsbench.files import write_json
from gsbench.parsing import Record, read_if_sound
from gsbench.runs.commands import PlannedTrial
from gsbench.runs.configuration import determining_settings
from gsbench.runs.experiments import experiment_home, trial_folders
from gsbench.runs.layout import CONFIG, FAILED, LOCK, RESULTS, SEED, SUBMITTED
from gsbench.runs.trial_folder import State, TrialFolder
from gsbench.system.locks import read_holder
from gsbench.system.programs import answer_of
from gsbench.words import as_line, counted

if TYPE_CHECKING:
    import pandas as pd

    from gsbench.config.compose import Trial


COLUMNS = ("done", "running", "failed", "waiting")  # of `progress_frame`


class Kind(NamedTuple):
    """The meaning of a state for the verbs that show and repeat trials."""

    column: str = "waiting"
    retried: bool = False  # `gsbench retry` runs it again
    freed: bool = False  # `gsbench clean NAME` lets its results go
    lasts: bool = False  # it began, and goes on


# in the order of lists: what needs a look comes first
STATES = {
    "failed": Kind("failed", retried=True, freed=True),
    "damaged": Kind(retried=True),
    "running": Kind("running", lasts=True),
    "queued": Kind(lasts=True),
    "partial": Kind(retried=True, freed=True),
    "missing": Kind(retried=True),
    "superseded": Kind(freed=True),
    "done": Kind("done"),
}


def summary_of(states: Iterable[str]) -> str:
    """The number of trials in each state, in one line."""
    counts = Counter(states)
    texts = [f"{counts[state]} {state}" for state in reversed(STATES) if counts[state]]
    return f"{counted(counts.total(), 'trial')}: {', '.join(texts)}"


@dataclass(frozen=True)
class TrialState:
    """A trial's state, the time at which it began (Unix time), a note, and its entry in the plan.

    A ``queued`` trial waits in Slurm's queue. A finished trial is ``superseded`` if its code is
    earlier than that of tables (`newest_code`); a failed one if a trial of later code has the same
    settings.
    """

    folder: Path
    state: State | Literal["queued", "superseded"]
    since: float | None
    note: str
    planned: PlannedTrial | None = None

    @property
    def overrides(self) -> tuple[str, ...]:
        """The words of its command, as far as they are known."""
        return self.planned.words if self.planned else ()


def states_of_experiment(home: Path) -> list[TrialState]:
    """The states of all trials of the experiment in ``home``, planned or with a folder."""
    experiment = read_experiment(home)
    plan = experiment.history.planned
    begun = {
        path
        for path in map(Path, trial_folders(home))
        if SEED in path.name and (path / CONFIG).exists()
    }
    folders = sorted({*plan, *begun})
    queue = ask_queue(folders)
    states = [_state(folder, plan.get(folder), queue) for folder in folders]
    # In a ledger, each idea has its own code, and its trials are its result.
    older = () if experiment.history.ledger else newest_code(experiment).older
    return _mark_superseded(states, {trial.path for trial in older})


def _mark_superseded(trials: Sequence[TrialState], older: Collection[Path]) -> list[TrialState]:
    """Mark as superseded the ``older`` ones, and those with whose settings another got further.

    Such failed and stopped trials differ from the other one only in the code of a user's class,
    which was repaired in between.
    """
    further = group_by(
        (one for one in trials if one.state in ("done", "running", "queued")),
        lambda one: _arm_and_seed(one.folder),
    )

    def marked(trial: TrialState) -> TrialState:
        if trial.state == "done" and trial.folder in older:
            return replace(trial, state="superseded", note="made by earlier code")
        if trial.state in ("failed", "partial") and (settings := _settings(trial.folder)):
            for other in further.get(_arm_and_seed(trial.folder), ()):
                if _settings(other.folder) == settings:
                    note = f"{other.folder.name} is {other.state}, made by later code: {trial.note}"
                    return replace(trial, state="superseded", note=note)
        return trial

    return list(map(marked, trials))


def _arm_and_seed(folder: Path) -> tuple[Path, str]:
    """The arm's folder, and the seed in the name of a trial's folder."""
    return folder.parent, folder.name.partition("-")[2]


def _settings(folder: Path) -> dict[str, Any] | None:
    try:
        return determining_settings(TrialFolder(folder).configuration())
    except InputError:
        return None


def _state(folder: Path, planned: PlannedTrial | None, queue: Queue | None) -> TrialState:
    """The state of the trial in ``folder``; ``planned`` is its entry in the plan."""
    files = TrialFolder(folder)
    state: Any = files.state()
    lost = ""  # its job has left the queue, without a result
    if state not in ("done", "damaged", "running") and (submission := read_submission(folder)):
        if in_queue := state_in_queue(folder, queue):
            job = queue.get(submission.job) if queue is not None else None
            answer = job.words if job else "Slurm does not answer"
            note = f"{_progress(folder)} Slurm job {submission.job}, {answer}".strip()
            return TrialState(folder, in_queue, _changed(folder / SUBMITTED), note, planned)
        lost = f"; Slurm job {submission.job} has ended, log: {submission.log}"
    if state == "running":
        holder = read_holder(folder / LOCK)
        since = None if holder is None else holder.since
        process = "process ? on ?" if holder is None else holder.description
        note = f"{_progress(folder)} {process}".strip()
    elif state == "done":
        since, note = _changed(folder / RESULTS), files.record().remark
    elif state == "damaged":
        since, note = _changed(folder / RESULTS), str(files.change() or files.why_not_done({}))
    elif state == "failed":
        since, note = _changed(folder / FAILED), files.failure().reason
    elif state == "partial":
        since, note = _changed(folder / CONFIG), f"stopped {_progress(folder)}".strip() + lost
    else:
        since, note = planned.time if planned else None, "never started" + lost
    return TrialState(folder, state, since, note, planned)


def _progress(folder: Path) -> str:
    """``in train at iteration 7000``; "" if no stage has begun."""
    stage, step = TrialFolder(folder).stage_and_step()
    text = f"in {stage}" if stage else ""
    return f"{text} at iteration {step}" if stage == "train" and step else text


def _changed(path: Path) -> float | None:
    try:
        return path.stat().st_mtime
    except OSError:
        return None


# ---- Slurm's queue

SECONDS_TO_ANSWER = 60.0
WAITING = (
    "PENDING",
    "CONFIGURING",
    "REQUEUED",
    "REQUEUE_HOLD",
    "REQUEUE_FED",
    "RESV_DEL_HOLD",
    "SPECIAL_EXIT",
)


class Submission(Record):
    """``.submitted.json``: a trial's Slurm job, its log, and its user."""

    job: Annotated[str, Field(pattern=r"^[\w.\[\]%-]+$")]
    log: str = "unknown"
    user: Annotated[str, Field(pattern=r"^[\w.@\\+-]*$")] = ""


@dataclass(frozen=True)
class QueuedJob:
    """A job or array task in the queue: its state as Slurm names it, and why it waits."""

    state: str
    reason: str

    @property
    def waits(self) -> bool:
        """Return whether the job waits to start, for the first time or again."""
        return self.state in WAITING

    @property
    def words(self) -> str:
        """The state in words: ``pending (Resources)``."""
        return self.state.lower() + (f" ({self.reason})" if self.reason not in ("", "None") else "")


Queue = Mapping[str, QueuedJob]


def record_submission(folder: Path, job: str, log: Path) -> None:
    """Record in the trial's ``folder`` that it was submitted as ``job``."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / SUBMITTED, Submission(job=job, log=str(log), user=current_user()).to_json())


def read_submission(folder: Path) -> Submission | None:
    """The last job of the trial in ``folder``; None if none, or if it ended normally."""
    return read_if_sound(folder / SUBMITTED, Submission)


def forget_submission(folder: Path) -> None:
    """Record that the job of the trial in ``folder`` has ended."""
    (folder / SUBMITTED).unlink(missing_ok=True)


def ask_queue(folders: Iterable[Path]) -> Queue | None:
    """The queue of all users who submitted trials in ``folders``; None if Slurm does not answer."""
    submissions = list(filter(None, map(read_submission, folders)))
    return (
        read_queue({submission.user or current_user() for submission in submissions})
        if submissions
        else {}
    )


def state_in_queue(folder: Path, queue: Queue | None) -> Literal["queued", "running"] | None:
    """The state in Slurm of an unfinished trial that no process holds; None if it is not in Slurm.

    If Slurm does not answer (``queue`` is None), a submitted trial is assumed to be queued.
    """
    submission = read_submission(folder)
    if submission is None or (queue is not None and submission.job not in queue):
        return None
    return "queued" if queue is None or queue[submission.job].waits else "running"


def read_queue(users: Iterable[str]) -> Queue | None:
    """The jobs and array tasks of ``users`` by id; None if Slurm does not answer."""
    chosen = f"--user={','.join(sorted(users))}"
    words = ["squeue", chosen, "--noheader", "--array", "--format=%i|%T|%r"]
    listing = answer_of(words, SECONDS_TO_ANSWER)
    if listing is None:
        return None
    lines = [line.split("|") for line in listing.splitlines() if line.count("|") == 2]
    return {job: QueuedJob(state, reason) for job, state, reason in lines}


def current_user() -> str:
    """The user's name, or the user id if there is no name, as in some containers."""
    return psutil.Process().username()


# ---- the names of arms

OF_A_PLACE = ("seed", "scene", "scene.path", "name")  # overrides that tell no arms apart


def arm_names(trials: Iterable[Trial | TrialState]) -> dict[Path, str]:
    """The arm of each trial's folder, from the words of its command.

    If an arm's folder has several settings, the words in which their commands differ are added:
    ``sfm-momentum[decay=0.9]``. Without such words it is the settings' hash.
    """
    names = {}
    words = {trial.folder: _settings_of(trial.overrides) for trial in trials}
    for arm, folders in group_by(words, "parent.name").items():
        shared = set.intersection(*(words[folder] for folder in folders))
        hashes = {folder: folder.name.partition(SEED)[0] for folder in folders}
        for folder in folders:
            values = ", ".join(sorted(words[folder] - shared)) or hashes[folder]
            names[folder] = f"{arm}[{values}]" if len({*hashes.values()}) > 1 else arm
    return names


def labels_of(trials: Sequence[Trial | TrialState]) -> dict[Path, str]:
    """``TrialFolder.label`` of each trial's folder, with the arm's name of `arm_names`."""
    labels = {}
    for folder, arm in arm_names(trials).items():
        hash8, _, seed = folder.name.partition(SEED)
        arm = arm.removesuffix(f"[{hash8}]")
        labels[folder] = f"{folder.parents[1].name}/{arm} seed {seed} ({hash8})"
    return labels


def _settings_of(overrides: Iterable[str]) -> set[str]:
    """The settings in a command by their last names, without a trial's place."""
    given = (as_line(word).lstrip("+~").partition("=") for word in overrides)
    return {f"{key.rpartition('.')[2]}={value}" for key, _, value in given if key not in OF_A_PLACE}


def progress_frame(runs: Path, experiment: str) -> pd.DataFrame:
    """A row for each arm of an experiment, as ``gsbench status --watch`` shows it.

    It has the numbers of trials that are done, running, failed and waiting. Raises InputError for
    an unknown experiment.
    """
    import pandas as pd

    states = states_of_experiment(experiment_home(runs, experiment))
    # A superseded trial will never be done, so with it no sweep would end.
    states = [one for one in states if one.state != "superseded"]
    names = arm_names(states)
    counts = Counter((names[one.folder], STATES[one.state].column) for one in states)
    arms = sorted({*names.values()})
    rows = {arm: [counts[arm, column] for column in COLUMNS] for arm in arms}
    return pd.DataFrame.from_dict(rows, orient="index", columns=[*COLUMNS])
