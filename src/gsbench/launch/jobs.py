"""Trials as jobs of submitit, and running them in processes of this machine (`gsbench.launch.slurm`: in a cluster).

A job runs one trial and returns its outcome. Whether a trial is done is decided by its files alone, since a scheduler
may report a process wrongly.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbench.config.compose import Trial
from gsbench.files import require_no_links
from gsbench.launch.serial import Outcome, outcome_of_results
from gsbench.launch.states import forget_submission
from gsbench.runs.keys import sha256_of
from gsbench.runs.layout import JOBS
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.isolate import error_tail
from gsbench.system.own_modules import adopt_modules, allowed_modules
from gsbench.system.resources import assign_gpu, assign_threads, take_slot
from gsbench.system.stopping import SIGNALS, SIGNALS_WITHOUT_INTERRUPT, Stopped, interrupts_ignored, stop_on_signals
from gsbench.tracking import Mirror
from gsbench.words import counted

if TYPE_CHECKING:
    from submitit import Executor, Job
    from submitit.helpers import DelayedSubmission

log = logging.getLogger(__name__)

SECONDS_BETWEEN_POLLS = 1.0
DAYS = 24 * 60  # minutes


@dataclass
class TrialJob:
    """The callable that submitit runs. When its time is up, submitit requeues what ``checkpoint`` returns."""

    values: dict[str, Any]
    path: list[str]  # sys.path of the submitting process
    own: dict[str, str]  # the user's modules that may be imported, with their paths
    visible_gpus: str | None  # CUDA_VISIBLE_DEVICES of the submitting process

    def __call__(self) -> Outcome:
        sys.path[:] = [*self.path, *(entry for entry in sys.path if entry not in self.path)]
        adopt_modules(self.own)
        from gsbench.logs import set_up_logging

        set_up_logging()
        launch = self.values["launch"]
        # submitit's own handler requeues the job; it is called below, after the trial has saved a checkpoint.
        requeue = signal.getsignal(signal.SIGUSR2) if hasattr(signal, "SIGUSR2") else None
        try:
            with (
                stop_on_signals(SIGNALS_WITHOUT_INTERRUPT if launch["name"] == "local" else SIGNALS),
                ExitStack() as stack,
            ):
                if launch["name"] == "local":
                    slot = stack.enter_context(take_slot(TrialFolder.of(self.values).runs, launch["parallel"]))
                    assign_gpu(slot, self.visible_gpus)
                assign_threads(self.values["threads"], launch["parallel"])
                from gsbench.launch.serial import run_one

                # With launch=local, the sweep's own process mirrors all of its trials.
                mirror = stack.enter_context(Mirror(idle=launch["name"] == "local"))
                outcome = run_one(Trial(self.values, ()), mirror, wait=True)
                if outcome.status == "failed":
                    print(outcome.message, file=sys.stderr)  # for the job's log: the trial's folder may lack the reason
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
    """Run the trials in processes of this machine, ``launch.parallel`` at once; return when all have ended."""
    values = trials[0].values
    parallel, name = values["launch"]["parallel"], values["name"]
    import submitit

    # Nothing else is printed until the first trial ends, since trials write to their own logs.
    log.info(
        "%s, %d at once; to see how far they are: gsbench status %s", counted(len(trials), "trial"), parallel, name
    )
    executor = submitit.LocalExecutor(job_folder(values))
    executor.update_parameters(timeout_min=values["launch"]["timeout_min"] or 365 * DAYS)
    return _run(trials, executor, parallel, mirror)


def job_folder(values: dict[str, Any]) -> Path:
    """The folder for the output of an experiment's jobs; it is made if it does not exist."""
    runs = TrialFolder.of(values).runs
    folder = runs / JOBS / values["name"]
    require_no_links(runs, folder)
    # submitit leaves a link to each job script. Nobody reads it again, and `require_no_links` below would refuse it.
    for link in folder.glob(".submission_file_*.sh"):
        if link.is_symlink():
            link.unlink(missing_ok=True)
    require_no_links(runs, folder, below=True)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _run(trials: Sequence[Trial], executor: Executor, parallel: int, mirror: Mirror) -> list[Outcome]:
    """Run at most ``parallel`` processes at once. If this process is stopped it stops them; if killed, they go on."""
    waiting, running, outcomes = clouds_first(trials), dict[Path, "Job[Outcome]"](), list[Outcome]()
    try:
        while waiting or running:
            while waiting and len(running) < parallel:
                trial = waiting.pop(0)
                # Ctrl-C reaches all processes of a terminal: jobs ignore it, and this process passes it on below.
                with interrupts_ignored():
                    running[trial.folder] = executor.submit(job_of(trial))
                mirror.follow(trial.folder, trial.values["tracking"])
            ended = [folder for folder, job in running.items() if job.done()]
            for folder in ended:
                outcomes.append(collect(running.pop(folder), folder, trials))
                log.info("%s: %s  (%d of %d)", outcomes[-1].label, outcomes[-1].message, len(outcomes), len(trials))
            if not ended:
                time.sleep(SECONDS_BETWEEN_POLLS)
    except KeyboardInterrupt:
        for job in running.values():
            process = getattr(job, "_process", None)
            if process is not None and process.poll() is None:
                process.send_signal(signal.SIGTERM)  # submitit's controller passes it on; the trial saves a checkpoint
        raise
    return outcomes


def clouds_first(trials: Sequence[Trial]) -> list[Trial]:
    """The trials, reordered: one of each scene and initialiser comes first.

    Trials with the same initial cloud wait for each other, so running them at once would leave processes idle.
    """
    by_cloud: dict[str, Trial] = {}
    for trial in trials:
        by_cloud.setdefault(sha256_of([trial.values["scene"], trial.values["init"]]), trial)
    first = list(by_cloud.values())
    return first + [trial for trial in trials if all(trial is not other for other in first)]


def collect(job: Job[Outcome], folder: Path, trials: Sequence[Trial]) -> Outcome:
    """The outcome of an ended job, from the trial's files, or else from the end of the job's log."""
    values = next(trial.values for trial in trials if trial.folder == folder)
    files, log_file = TrialFolder(folder), job.paths.stderr
    record = files.sound_record()
    unavailable = () if record is None else record.awaited  # the trial has just ended, so they are still unavailable
    reason = files.why_not_done(values, lambda options: unavailable)
    if record is not None and not reason:
        return outcome_of_results(folder, record)
    if files.has_failed():
        failure = files.failure()
        return Outcome(folder, "failed", f"{failure.reason}; log: {log_file}", failure.bad_input)
    if record is not None:
        return Outcome(folder, "failed", f"its results no longer hold ({reason}): give the command again")
    tail = f"; its last lines: {error_tail(log_file)}" if log_file.is_file() else ""
    return Outcome(
        folder, "failed", f"the process ended without a result (killed, or out of memory){tail}; log: {log_file}"
    )


def job_of(trial: Trial) -> TrialJob:
    """The trial as a job with the environment of this process."""
    path = [entry for entry in sys.path if entry]
    return TrialJob(trial.values, path, allowed_modules(), os.environ.get("CUDA_VISIBLE_DEVICES"))
