"""The states of trials, from their folders and from Slurm's queue, and the names of their arms.

A file in a trial's folder names its Slurm job. Loads no torch.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import psutil
from pydantic import Field

from gsbench.analysis.results import newest_code, read_experiment
from gsbench.errors import InputError
from gsbench.files import write_json
from gsbench.parsing import Record, read_if_sound
from gsbench.runs.commands import PlannedTrial, read_history
from gsbench.runs.config_hash import determining_settings
from gsbench.runs.experiments import trial_folders
from gsbench.runs.layout import CONFIG, FAILED, LOCK, RESULTS, SEED, SUBMITTED
from gsbench.runs.trial_folder import State, TrialFolder
from gsbench.system.locks import read_holder
from gsbench.system.programs import answer_of
from gsbench.words import as_line, counted


class Kind(NamedTuple):
    """The meaning of a state for the verbs that show and repeat trials."""

    column: str = "waiting"  # of `gsbench.launch.progress.progress_frame`
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


EARLIER_CODE = "made by earlier code"


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


def states_of_experiment(home: Path) -> list[TrialState]:
    """The states of all trials of the experiment in ``home``, planned or with a folder."""
    plan = read_history(home).planned
    begun = {
        path
        for path in map(Path, trial_folders(home))
        if SEED in path.name and (path / CONFIG).exists()
    }
    folders = sorted({*plan, *begun})
    queue = ask_queue(folders)
    states = [_state(folder, plan.get(folder), queue) for folder in folders]
    return _mark_superseded([replace(state, planned=plan.get(state.folder)) for state in states])


def states_now(home: Path) -> list[TrialState]:
    """The same, with finished trials that no table counts as ``superseded``; reads all results."""
    states = states_of_experiment(home)
    experiment = read_experiment(home)
    older = {trial.path for trial in newest_code(experiment).older}
    if experiment.history.ledger is not None:
        older = set()  # each idea has its own code, and its trials are its result
    return [
        replace(state, state="superseded", note=EARLIER_CODE)
        if state.state == "done" and state.folder in older
        else state
        for state in states
    ]


def _mark_superseded(trials: Sequence[TrialState]) -> list[TrialState]:
    """Mark failed and stopped trials as superseded if one with the same settings got further.

    Such trials differ only in the code of a user's class, which was repaired in between.
    """
    further: dict[tuple[Path, str], list[TrialState]] = {}
    for trial in trials:
        if trial.state in ("done", "running", "queued"):
            further.setdefault(_arm_and_seed(trial.folder), []).append(trial)
    states = []
    for trial in trials:
        if trial.state in ("failed", "partial"):
            others, settings = further.get(_arm_and_seed(trial.folder), []), _settings(trial.folder)
            later = next((other for other in others if _settings(other.folder) == settings), None)
            if settings is not None and later is not None:
                note = f"{later.folder.name} is {later.state}, made by later code: {trial.note}"
                trial = replace(trial, state="superseded", note=note)
        states.append(trial)
    return states


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
    state, lost = files.state(), ""  # ``lost``: its job has left the queue, without a result
    if state == "running":
        holder = read_holder(folder / LOCK)
        process = "process ? on ?" if holder is None else holder.description
        since = None if holder is None else holder.since
        return TrialState(folder, state, since, f"{_progress(folder)} {process}".strip())
    if state not in ("done", "damaged") and (submission := read_submission(folder)):
        if in_queue := state_in_queue(folder, queue):
            job = queue.get(submission.job) if queue is not None else None
            answer = job.words if job else "Slurm does not answer"
            note = f"{_progress(folder)} Slurm job {submission.job}, {answer}".strip()
            return TrialState(folder, in_queue, _changed(folder / SUBMITTED), note)
        lost = f"; Slurm job {submission.job} has ended, log: {submission.log}"
    if state == "done":
        file, note = RESULTS, files.record().remark
    elif state == "damaged":
        file, note = RESULTS, str(files.change() or files.why_not_done({}))
    elif state == "failed":
        file, note = FAILED, files.failure().reason
    elif state == "partial":
        file, note = CONFIG, f"stopped {_progress(folder)}".strip() + lost
    else:
        since = None if planned is None else planned.time
        return TrialState(folder, state, since, "never started" + lost)
    return TrialState(folder, state, _changed(folder / file), note)


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


def arm_names(overrides: Mapping[Path, Iterable[str]]) -> dict[Path, tuple[str, str]]:
    """Arm and scene of each trial's folder, from the overrides of its command.

    If an arm's folder has several settings, the overrides in which their commands differ are added:
    ``sfm-momentum[decay=0.9]``. Without such overrides it is the settings' hash.
    """
    by_arm: dict[str, list[Path]] = {}
    for folder in overrides:
        by_arm.setdefault(folder.parent.name, []).append(folder)
    names = {}
    for arm, of_arm in by_arm.items():
        given = {folder: _settings_of(overrides[folder]) for folder in of_arm}
        shared = set.intersection(*given.values())
        several = len({folder.name.partition(SEED)[0] for folder in of_arm}) > 1
        for folder in of_arm:
            values = ", ".join(sorted(given[folder] - shared)) or folder.name.partition(SEED)[0]
            names[folder] = (f"{arm}[{values}]" if several else arm, folder.parents[1].name)
    return names


def names_of(states: Sequence[TrialState]) -> dict[Path, tuple[str, str]]:
    """`arm_names` of trials from their entries in the plan."""
    return arm_names(
        {state.folder: state.planned.words if state.planned else () for state in states}
    )


def label_of(folder: Path, names: Mapping[Path, tuple[str, str]]) -> str:
    """``TrialFolder.label`` with the arm's name of `arm_names`."""
    (arm, scene), (hash8, _, seed) = names[folder], folder.name.partition(SEED)
    arm = arm.removesuffix(f"[{hash8}]")
    return f"{scene}/{arm} seed {seed} ({hash8})"


def _settings_of(overrides: Iterable[str]) -> set[str]:
    """The settings in a command by their last names, without a trial's place."""
    given = (as_line(word).lstrip("+~").partition("=") for word in overrides)
    return {f"{key.rpartition('.')[2]}={value}" for key, _, value in given if key not in OF_A_PLACE}
