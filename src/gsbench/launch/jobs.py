"""Running trials: one after the other in this process, or in processes of this machine.

There, and in Slurm (`gsbench.launch.slurm`), a trial is a job of submitit, which returns its
outcome. Whether a trial is done is decided by its files alone, since a scheduler may report a
process wrongly. A trial that would fail as an earlier one did is not started.
"""

from __future__ import annotations

import logging
import os
import re
import secrets
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from gsbench.config.compose import Trial
from gsbench.errors import GsbenchError, InputError
from gsbench.files import DiskFullError, require_no_links
from gsbench.launch.states import forget_submission, labels_of
from gsbench.logs import bar, set_up_logging
from gsbench.runs.commands import digest_of
from gsbench.runs.configuration import flatten, sha256_of
from gsbench.runs.layout import JOBS, LOG
from gsbench.runs.trial_folder import TrialFolder
from gsbench.runs.trial_record import TrialRecord
from gsbench.system.isolate import error_tail
from gsbench.system.locks import BusyError
from gsbench.system.programs import adopt_modules, allowed_modules
from gsbench.system.resources import assign_gpu, assign_threads, names_one_gpu, take_slot
from gsbench.system.stopping import (
    SIGNALS,
    SIGNALS_WITHOUT_INTERRUPT,
    Stopped,
    interrupts_ignored,
    stop_on_signals,
)
from gsbench.tracking import Mirror
from gsbench.words import command, counted

if TYPE_CHECKING:
    from submitit import Job
    from submitit.helpers import DelayedSubmission

    Running = tuple[Trial, "Job[Outcome]"]

JOB_LINK = re.compile(r"\.submission_file_.*\.sh")

log = logging.getLogger(__name__)


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


# ---- trials in this process


def say_last(outcomes: Sequence[Outcome], labels: Mapping[Path, str]) -> None:
    """Log the outcome of the trial that ended last, and how many have ended."""
    last, label = outcomes[-1], labels[outcomes[-1].folder]
    log.info("%s: %s  (%d of %d)", label, last.message, len(outcomes), len(labels))


def run_serial(trials: Sequence[Trial]) -> list[Outcome]:
    """Run the trials in this process, one after the other.

    A trial that another process is running comes last, so that two sweeps share the work.
    """
    outcomes: list[Outcome] = []
    busy: list[Trial] = []
    labels, repeats = labels_of(trials), Repeats()
    for number, trial in enumerate(trials, 1):
        if repeated := repeats.of(trial):
            outcomes.append(repeated)
            continue
        if len(trials) > 1:
            log.info("%d of %d: %s", number, len(trials), labels[trial.folder])
        try:
            outcomes.append(run_one(trial, wait=len(trials) == 1))
            repeats.note(trial, outcomes[-1])
        except BusyError as error:
            log.info("%s; later", error)
            busy.append(trial)
    return outcomes + [run_one(trial, wait=True) for trial in busy]


def run_one(trial: Trial, wait: bool) -> Outcome:
    """Run one trial.

    Errors become its outcome, except BusyError, DiskFullError, and exceptions that end the program.
    """
    try:
        # imported here, because a finished sweep needs no torch
        from gsbench.pipeline.trial import run_trial

        return outcome_of_results(trial.folder, run_trial(trial, wait))
    except (BusyError, DiskFullError):
        raise
    except Exception as error:  # noqa: BLE001 - a failed trial does not stop the others
        return outcome_of_error(trial.folder, error)


# ---- processes of this machine

SECONDS_BETWEEN_POLLS = 1.0
DAYS = 24 * 60  # minutes
BAR = 1000  # parts of a trial in the bar of a sweep


@dataclass
class TrialJob:
    """The callable that submitit runs.

    When its time is up, submitit requeues what ``checkpoint`` returns.
    """

    trial: Trial
    # sys.path of the submitting process
    path: list[str] = field(default_factory=lambda: [entry for entry in sys.path if entry])
    # the user's modules that may be imported, with their paths
    own: dict[str, str] = field(default_factory=allowed_modules)
    visible_gpus: str | None = field(default_factory=lambda: os.environ.get("CUDA_VISIBLE_DEVICES"))
    digest: str = ""  # of settings and code when the command was given

    def __post_init__(self) -> None:
        self.digest = self.digest or digest_of(self.trial.values)

    def __call__(self) -> Outcome:
        sys.path[:] = [*self.path, *(entry for entry in sys.path if entry not in self.path)]
        adopt_modules(self.own)
        set_up_logging()
        trial, values = self.trial, self.trial.values
        launch = values["launch"]
        # submitit's own handler requeues the job; it is called below, after the trial has saved a
        # checkpoint.
        requeue = signal.getsignal(signal.SIGUSR2) if hasattr(signal, "SIGUSR2") else None
        try:
            with (
                stop_on_signals(
                    SIGNALS_WITHOUT_INTERRUPT if launch["name"] == "local" else SIGNALS
                ),
                ExitStack() as stack,
            ):
                if launch["name"] == "local":
                    slot = stack.enter_context(take_slot(trial.files.runs, launch["parallel"]))
                    # A number as in cuda:1 counts the GPUs that the parent sees.
                    if not names_one_gpu(values["device"]):
                        assign_gpu(slot, self.visible_gpus)
                assign_threads(values["threads"], launch["parallel"])
                # With launch=local, the sweep's own process mirrors all of its trials.
                stack.enter_context(Mirror([trial] if launch["name"] == "slurm" else []))
                if digest_of(values) != self.digest:
                    error = InputError("code changed since the command; give it again")
                    outcome = outcome_of_error(trial.folder, error)
                else:
                    outcome = run_one(trial, wait=True)
                if outcome.status == "failed":
                    # for the job's log: the trial's folder may lack the reason
                    print(outcome.message, file=sys.stderr)
                if launch["name"] == "slurm":
                    with suppress(OSError):
                        forget_submission(outcome.folder)
                return outcome
        except Stopped as stop:
            if stop.signum == getattr(signal, "SIGUSR2", None) and callable(requeue):
                requeue(stop.signum, None)  # ends the process
            sys.exit(stop.exit_code)

    def checkpoint(self) -> DelayedSubmission:
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def run_local(trials: Sequence[Trial]) -> list[Outcome]:
    """Run the trials in processes of this machine, ``launch.parallel`` at once, to the end.

    If this process is stopped, it stops them; if it is killed, they go on.
    """
    import submitit

    values = trials[0].values
    parallel, name = values["launch"]["parallel"], values["name"]
    # Nothing else is printed until the first trial ends, since trials write to their own logs.
    log.info(
        "%s, %d at once; to see how far they are: %s",
        counted(len(trials), "trial"),
        parallel,
        command("status", name),
    )
    executor = submitit.LocalExecutor(new_job_folder(values))
    executor.update_parameters(timeout_min=values["launch"]["timeout_min"] or 365 * DAYS)
    waiting, running, outcomes = clouds_first(trials), dict[Path, "Running"](), list[Outcome]()
    labels, repeats = labels_of(trials), Repeats()
    try:
        with bar(name) as report:
            while waiting or running:
                while waiting and len(running) < parallel:
                    trial = waiting.pop(0)
                    if repeated := repeats.of(trial):
                        outcomes.append(repeated)
                        continue
                    # Ctrl-C reaches all processes of a terminal: jobs ignore it, and this process
                    # passes it on below.
                    with interrupts_ignored():
                        running[trial.folder] = trial, executor.submit(TrialJob(trial))
                ended = [folder for folder, (_, job) in running.items() if job.done()]
                for folder in ended:
                    trial, job = running.pop(folder)
                    outcomes.append(collect(job, trial))
                    repeats.note(trial, outcomes[-1])
                    say_last(outcomes, labels)
                done = len(outcomes) + sum(
                    trial.files.share_done(trial.values["train"]["iterations"])
                    for trial, _ in running.values()
                )
                note = f"{len(outcomes)} of {len(trials)} trials, {len(running)} running"
                report("trials", round(BAR * done), BAR * len(trials), note)
                if not ended:
                    time.sleep(SECONDS_BETWEEN_POLLS)
    except KeyboardInterrupt:
        for _, job in running.values():
            # submitit's own `cancel` kills at once; its process is no public attribute
            process = getattr(job, "_process", None)
            if process is not None and process.poll() is None:
                # submitit's controller passes it on; the trial saves a checkpoint
                process.send_signal(signal.SIGTERM)
        raise
    return outcomes


def check_job_links(runs: Path, folder: Path) -> None:
    """Raise InputError for a link at or below ``folder`` in the runs folder ``runs``.

    The links to job scripts that submitit leaves there are removed: they are not read again.
    """
    # First the folder itself: through a link, files of another folder would be removed.
    require_no_links(runs, folder)
    for place, _, names in os.walk(folder):
        for link in (Path(place, name) for name in names if JOB_LINK.fullmatch(name)):
            if link.is_symlink():
                link.unlink(missing_ok=True)
    require_no_links(runs, folder, below=True)


def new_job_folder(values: dict[str, Any]) -> Path:
    """A new folder for the output of an experiment's jobs, whose name nobody could guess.

    A job unpickles the first file that has its number in its name. A stranger's runs folder could
    have such files for all numbers.
    """
    runs = TrialFolder.of(values).runs
    of_experiment = runs / JOBS / values["name"]
    check_job_links(runs, of_experiment)
    folder = of_experiment / secrets.token_hex(8)
    folder.mkdir(parents=True)
    return folder


def clouds_first(trials: Sequence[Trial]) -> list[Trial]:
    """The trials, reordered: one of each scene and initialiser comes first.

    Trials with the same initial cloud wait for each other, so running them at once would leave
    processes idle.
    """
    first: dict[str, Path] = {}  # folders by cloud
    for trial in trials:
        first.setdefault(sha256_of([trial.values["scene"], trial.values["init"]]), trial.folder)
    leading = set(first.values())
    return sorted(trials, key=lambda trial: trial.folder not in leading)


def collect(job: Job[Outcome], trial: Trial) -> Outcome:
    """The outcome of an ended job, from the trial's files, else from the end of its log."""
    folder, files, log_file = trial.folder, trial.files, job.paths.stderr
    record = files.sound_record()
    # The trial has just ended, so the metrics that it lacked are still unavailable.
    unavailable = () if record is None else record.awaited
    reason = files.why_not_done(trial.values, lambda options: unavailable)
    bad_input = False
    if record is not None and not reason:
        return outcome_of_results(folder, record)
    if files.has_failed():
        failure = files.failure()
        bad_input, message = failure.bad_input, f"{failure.reason}; log: {log_file}"
    elif record is not None:
        message = f"its results no longer hold ({reason}): give the command again"
    else:
        tail = f"; its last lines: {error_tail(log_file)}" if log_file.is_file() else ""
        message = (
            f"the process ended without a result (killed, or out of memory){tail}; log: {log_file}"
        )
    return Outcome(folder, "failed", message, bad_input)
