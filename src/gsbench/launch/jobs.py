"""Running trials: one after the other in this process, or in processes of this machine.

There, and in Slurm (`gsbench.launch.slurm`), a trial is a job of submitit, which returns its
outcome. Whether a trial is done is decided by its files alone, since a scheduler may report a
process wrongly.
"""

from __future__ import annotations

import logging
import os
import re
import secrets
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbench.config.compose import Trial
from gsbench.errors import InputError
from gsbench.files import DiskFullError, require_no_links
from gsbench.launch.outcomes import Outcome, Repeats, outcome_of_error, outcome_of_results
from gsbench.launch.states import arm_names, forget_submission, label_of
from gsbench.logs import bar, set_up_logging
from gsbench.runs.commands import digest_of
from gsbench.runs.layout import JOBS
from gsbench.runs.nested import sha256_of
from gsbench.runs.trial_folder import TrialFolder
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
    from submitit import Executor, Job
    from submitit.helpers import DelayedSubmission


JOB_LINK = re.compile(r"\.submission_file_.*\.sh")

log = logging.getLogger(__name__)


def say_last(outcomes: Sequence[Outcome], labels: Mapping[Path, str]) -> None:
    """Log the outcome of the trial that ended last, and how many have ended."""
    last, label = outcomes[-1], labels[outcomes[-1].folder]
    log.info("%s: %s  (%d of %d)", label, last.message, len(outcomes), len(labels))


def labels_of(trials: Sequence[Trial]) -> dict[Path, str]:
    """The names of trials in messages, with the settings that distinguish their arms."""
    names = arm_names({trial.folder: trial.overrides for trial in trials})
    return {folder: label_of(folder, names) for folder in names}


def run_serial(trials: Sequence[Trial], mirror: Mirror) -> list[Outcome]:
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
            outcomes.append(run_one(trial, mirror, wait=len(trials) == 1))
            repeats.note(trial, outcomes[-1])
        except BusyError as error:
            log.info("%s; later", error)
            busy.append(trial)
    return outcomes + [run_one(trial, mirror, wait=True) for trial in busy]


def run_one(trial: Trial, mirror: Mirror, wait: bool) -> Outcome:
    """Run and mirror one trial.

    Errors become its outcome, except BusyError, DiskFullError, and exceptions that end the program.
    """
    mirror.follow(trial.folder, trial.values)
    try:
        # imported here, because a finished sweep needs no torch
        from gsbench.pipeline.trial import run_trial

        return outcome_of_results(trial.folder, run_trial(trial, wait))
    except (BusyError, DiskFullError):
        raise
    except Exception as error:  # noqa: BLE001 - a failed trial does not stop the others
        return outcome_of_error(trial.folder, error)
    finally:
        mirror.trial_ended()


# ---- processes of this machine

SECONDS_BETWEEN_POLLS = 1.0
DAYS = 24 * 60  # minutes
BAR = 1000  # parts of a trial in the bar of a sweep


@dataclass
class TrialJob:
    """The callable that submitit runs.

    When its time is up, submitit requeues what ``checkpoint`` returns.
    """

    values: dict[str, Any]
    path: list[str]  # sys.path of the submitting process
    own: dict[str, str]  # the user's modules that may be imported, with their paths
    visible_gpus: str | None  # CUDA_VISIBLE_DEVICES of the submitting process
    digest: str = ""  # of settings and code when the command was given

    def __call__(self) -> Outcome:
        sys.path[:] = [*self.path, *(entry for entry in sys.path if entry not in self.path)]
        adopt_modules(self.own)
        set_up_logging()
        launch = self.values["launch"]
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
                    slot = stack.enter_context(
                        take_slot(TrialFolder.of(self.values).runs, launch["parallel"])
                    )
                    # A number as in cuda:1 counts the GPUs that the parent sees.
                    if not names_one_gpu(self.values["device"]):
                        assign_gpu(slot, self.visible_gpus)
                assign_threads(self.values["threads"], launch["parallel"])
                # With launch=local, the sweep's own process mirrors all of its trials.
                mirror = stack.enter_context(Mirror(idle=launch["name"] == "local"))
                trial = Trial(self.values, ())
                if self.digest and digest_of(self.values) != self.digest:
                    error = InputError("code changed since the command; give it again")
                    outcome = outcome_of_error(trial.folder, error)
                else:
                    outcome = run_one(trial, mirror, wait=True)
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


def run_local(trials: Sequence[Trial], mirror: Mirror) -> list[Outcome]:
    """Run the trials in processes of this machine, ``launch.parallel`` at once, to the end."""
    values = trials[0].values
    parallel, name = values["launch"]["parallel"], values["name"]
    import submitit

    # Nothing else is printed until the first trial ends, since trials write to their own logs.
    log.info(
        "%s, %d at once; to see how far they are: %s",
        counted(len(trials), "trial"),
        parallel,
        command("status", name),
    )
    executor = submitit.LocalExecutor(new_job_folder(values))
    executor.update_parameters(timeout_min=values["launch"]["timeout_min"] or 365 * DAYS)
    with bar(values["name"]) as report:

        def show(ended: int, running: Sequence[Trial]) -> None:
            done = ended + sum(
                trial.files.share_done(trial.values["train"]["iterations"]) for trial in running
            )
            note = f"{ended} of {len(trials)} trials, {len(running)} running"
            report("trials", round(BAR * done), BAR * len(trials), note)

        return _run(trials, executor, parallel, mirror, show)


def job_folder(values: dict[str, Any]) -> Path:
    """The folder for the output of an experiment's jobs; it is made if it does not exist."""
    runs = TrialFolder.of(values).runs
    folder = runs / JOBS / values["name"]
    check_job_links(runs, folder)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


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
    """A new folder in `job_folder`, whose name nobody could guess.

    A job unpickles the first file that has its number in its name. A stranger's runs folder could
    have such files for all numbers.
    """
    folder = job_folder(values) / secrets.token_hex(8)
    folder.mkdir()
    return folder


def _run(
    trials: Sequence[Trial],
    executor: Executor,
    parallel: int,
    mirror: Mirror,
    show: Callable[[int, Sequence[Trial]], None] = lambda ended, running: None,
) -> list[Outcome]:
    """Run the trials in at most ``parallel`` processes at once.

    ``show`` gets the number of ended trials and those that run. If this process is stopped, it
    stops them; if it is killed, they go on.
    """
    waiting, running, outcomes = clouds_first(trials), dict[Path, "Job[Outcome]"](), list[Outcome]()
    labels, repeats, by_folder = labels_of(trials), Repeats(), {one.folder: one for one in trials}
    try:
        while waiting or running:
            while waiting and len(running) < parallel:
                trial = waiting.pop(0)
                if repeated := repeats.of(trial):
                    outcomes.append(repeated)
                    continue
                # Ctrl-C reaches all processes of a terminal: jobs ignore it, and this process
                # passes it on below.
                with interrupts_ignored():
                    running[trial.folder] = executor.submit(job_of(trial))
                mirror.follow(trial.folder, trial.values)
            ended = [folder for folder, job in running.items() if job.done()]
            for folder in ended:
                outcomes.append(collect(running.pop(folder), folder, trials))
                mirror.trial_ended()
                repeats.note(by_folder[folder], outcomes[-1])
                say_last(outcomes, labels)
            show(len(outcomes), [by_folder[folder] for folder in running])
            if not ended:
                time.sleep(SECONDS_BETWEEN_POLLS)
    except KeyboardInterrupt:
        for job in running.values():
            # submitit's own `cancel` kills at once; its process is no public attribute
            process = getattr(job, "_process", None)
            if process is not None and process.poll() is None:
                # submitit's controller passes it on; the trial saves a checkpoint
                process.send_signal(signal.SIGTERM)
        raise
    return outcomes


def clouds_first(trials: Sequence[Trial]) -> list[Trial]:
    """The trials, reordered: one of each scene and initialiser comes first.

    Trials with the same initial cloud wait for each other, so running them at once would leave
    processes idle.
    """
    by_cloud: dict[str, Trial] = {}
    for trial in trials:
        by_cloud.setdefault(sha256_of([trial.values["scene"], trial.values["init"]]), trial)
    first = list(by_cloud.values())
    return first + [trial for trial in trials if all(trial is not other for other in first)]


def collect(job: Job[Outcome], folder: Path, trials: Sequence[Trial]) -> Outcome:
    """The outcome of an ended job, from the trial's files, else from the end of its log."""
    values = next(trial.values for trial in trials if trial.folder == folder)
    files, log_file = TrialFolder(folder), job.paths.stderr
    record = files.sound_record()
    # The trial has just ended, so the metrics that it lacked are still unavailable.
    unavailable = () if record is None else record.awaited
    reason = files.why_not_done(values, lambda options: unavailable)
    if record is not None and not reason:
        return outcome_of_results(folder, record)
    if files.has_failed():
        failure = files.failure()
        return Outcome(folder, "failed", f"{failure.reason}; log: {log_file}", failure.bad_input)
    if record is not None:
        return Outcome(
            folder, "failed", f"its results no longer hold ({reason}): give the command again"
        )
    tail = f"; its last lines: {error_tail(log_file)}" if log_file.is_file() else ""
    return Outcome(
        folder,
        "failed",
        f"the process ended without a result (killed, or out of memory){tail}; log: {log_file}",
    )


def job_of(trial: Trial) -> TrialJob:
    """The trial as a job with the environment of this process."""
    path = [entry for entry in sys.path if entry]
    gpus = os.environ.get("CUDA_VISIBLE_DEVICES")
    return TrialJob(trial.values, path, allowed_modules(), gpus, digest_of(trial.values))
