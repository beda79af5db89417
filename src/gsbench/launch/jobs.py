"""Trials as jobs of submitit: in processes of this machine, or in Slurm.

A job runs one trial and returns its outcome. What counts as done is decided by the trial's files, never by what the
scheduler says of the process.
"""

from __future__ import annotations

import logging
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbench.compose import Composed
from gsbench.errors import InputError
from gsbench.files import read_object, write_json
from gsbench.install import install_command
from gsbench.launch.outcome import Outcome, outcome_of_results
from gsbench.pipeline.resources import assign_gpu, assign_threads, take_slot
from gsbench.pipeline.stopping import Stopped, stop_on_signals
from gsbench.pipeline.trial_files import TrialPaths, find_finished

if TYPE_CHECKING:
    from submitit import Executor, Job
    from submitit.helpers import DelayedSubmission

log = logging.getLogger(__name__)

SUBMITTED = ".submitted.json"  # in the trial's folder: the Slurm job that was given this trial
SECONDS_BETWEEN_POLLS = 1.0
SECONDS_BETWEEN_QUEUE_CHECKS = 20.0
CHECKS_UNTIL_LOST = 2  # a job that the queue does not know so often in a row, and that left no result, is lost
DAYS = 24 * 60  # minutes


@dataclass
class TrialJob:
    """The callable that submitit runs; submitit asks ``checkpoint`` for what to requeue when time is up."""

    values: dict[str, Any]
    yaml: str
    path: list[str]  # sys.path of the submitting process
    visible_gpus: str | None  # its CUDA_VISIBLE_DEVICES

    def __call__(self) -> Outcome:
        sys.path[:] = [*self.path, *(entry for entry in sys.path if entry not in self.path)]
        from gsbench.logs import set_up_logging

        set_up_logging()
        launch = self.values["launch"]
        by_submitit = signal.getsignal(signal.SIGUSR2) if hasattr(signal, "SIGUSR2") else None
        try:
            with stop_on_signals(), ExitStack() as stack:
                if launch["name"] == "local":
                    slot = stack.enter_context(take_slot(TrialPaths.of(self.values).runs, launch["parallel"]))
                    assign_gpu(slot, self.visible_gpus)
                assign_threads(self.values["threads"], launch["parallel"])
                from gsbench.launch.serial import run_one

                return run_one(Composed(self.values, self.yaml, ()), wait=True)
        except Stopped as stop:
            if stop.signum == getattr(signal, "SIGUSR2", None) and callable(by_submitit):
                by_submitit(stop.signum, None)  # requeues this job and ends the process
            sys.exit(stop.exit_code)

    def checkpoint(self) -> DelayedSubmission:
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def run_jobs(trials: Sequence[Composed]) -> list[Outcome]:
    """Run the trials by the launcher that they name, ``local`` or ``slurm``; returns when all have ended."""
    launch = trials[0].values["launch"]
    executor = make_executor(launch, TrialPaths.of(trials[0].values).runs / ".jobs" / trials[0].values["name"])
    _prepare_tracking(trials[0].values)
    if launch["name"] == "slurm":
        return _run_slurm(trials, executor)
    return _run_local(trials, executor, launch["parallel"])


def make_executor(launch: dict[str, Any], folder: Path) -> Executor:
    """The submitit executor for the settings ``launch``. Raises InputError where submitit or Slurm is missing."""
    try:
        import submitit
    except ImportError:
        raise InputError(
            f"launch={launch['name']} needs submitit: {install_command('slurm')} (or pip install submitit)"
        ) from None
    folder.mkdir(parents=True, exist_ok=True)
    if launch["name"] == "local":
        local = submitit.LocalExecutor(folder)
        local.update_parameters(timeout_min=launch["timeout_min"] or 365 * DAYS)
        return local
    try:
        slurm = submitit.SlurmExecutor(folder, max_num_timeout=launch["max_requeues"])
    except RuntimeError:
        raise InputError("launch=slurm: there is no srun here; start gsbench on a login node of the cluster") from None
    wanted = {
        "job_name": "gsbench",
        "partition": launch["partition"],
        "account": launch["account"],
        "qos": launch["qos"],
        "time": launch["timeout_min"],
        "cpus_per_task": launch["cpus_per_trial"],
        "gpus_per_node": launch["gpus_per_trial"] or None,
        "mem": None if launch["mem_gb"] is None else f"{launch['mem_gb']}GB",
        "signal_delay_s": launch["signal_seconds"],
        "array_parallelism": launch["parallel"],
        "setup": launch["setup"] or None,
        "additional_parameters": launch["sbatch"] or None,
    }
    slurm.update_parameters(**{key: value for key, value in wanted.items() if value is not None})
    return slurm


def _run_local(trials: Sequence[Composed], executor: Executor, parallel: int) -> list[Outcome]:
    """At most ``parallel`` processes at once; a stopped parent stops them, a killed one leaves them to finish."""
    waiting, running, outcomes = list(trials), dict[Path, "Job[Outcome]"](), list[Outcome]()
    try:
        while waiting or running:
            while waiting and len(running) < parallel and not any(outcome.fatal for outcome in outcomes):
                trial = waiting.pop(0)
                running[TrialPaths.of(trial.values).folder] = executor.submit(_job(trial))
            ended = [folder for folder, job in running.items() if job.done()]
            for folder in ended:
                outcomes.append(_collect(running.pop(folder), folder, trials))
                log.info("%s: %s  (%d of %d)", outcomes[-1].label, outcomes[-1].message, len(outcomes), len(trials))
            if not running and any(outcome.fatal for outcome in outcomes):
                break
            if not ended:
                time.sleep(SECONDS_BETWEEN_POLLS)
    except KeyboardInterrupt:
        for job in running.values():
            process = getattr(job, "_process", None)
            if process is not None and process.poll() is None:
                process.send_signal(signal.SIGTERM)  # the controller passes it on; the trial saves a checkpoint
        raise
    return outcomes


def _run_slurm(trials: Sequence[Composed], executor: Executor) -> list[Outcome]:
    """One array job; trials that an earlier command left in the queue are waited for, not submitted again."""
    import submitit

    folder = Path(executor.folder)
    jobs: dict[Path, Job[Outcome]] = {}
    queued = queued_jobs()
    fresh = []
    for trial in trials:
        home = TrialPaths.of(trial.values).folder
        job_id = read_object(home / SUBMITTED).get("job")
        if job_id in queued:
            jobs[home] = submitit.SlurmJob(folder, job_id)
        else:
            fresh.append(trial)
    if fresh:
        try:
            submitted = executor.submit_array([_job(trial) for trial in fresh])
        except Exception as error:
            raise InputError(f"Slurm refused the job: {' '.join(str(error).split())[:300]}") from error
        for trial, job in zip(fresh, submitted, strict=True):
            home = TrialPaths.of(trial.values).folder
            home.mkdir(parents=True, exist_ok=True)
            write_json(home / SUBMITTED, {"job": job.job_id})
            jobs[home] = job
    array = sorted({job.job_id.split("_")[0] for job in jobs.values()})
    log.info("%d trials in Slurm, job %s; logs: %s", len(jobs), ", ".join(array), folder)
    try:
        return _wait_for_slurm(jobs, trials)
    except KeyboardInterrupt:
        log.info(
            "the jobs stay in Slurm: the same command waits for them again, `scancel %s` ends them", " ".join(array)
        )
        raise


def _wait_for_slurm(jobs: dict[Path, Job[Outcome]], trials: Sequence[Composed]) -> list[Outcome]:
    outcomes: list[Outcome] = []
    unseen = dict.fromkeys(jobs, 0)
    checked = time.monotonic()
    while jobs:
        ended = [folder for folder, job in jobs.items() if job.paths.result_pickle.exists()]
        if time.monotonic() - checked > SECONDS_BETWEEN_QUEUE_CHECKS:
            checked = time.monotonic()
            queued = queued_jobs()
            for folder, job in jobs.items():
                unseen[folder] = 0 if job.job_id in queued else unseen[folder] + 1
            ended += [folder for folder in jobs if unseen[folder] >= CHECKS_UNTIL_LOST and folder not in ended]
        for folder in ended:
            outcomes.append(_collect(jobs.pop(folder), folder, trials))
            with suppress(OSError):
                (folder / SUBMITTED).unlink(missing_ok=True)
            log.info("%s: %s  (%d of %d)", outcomes[-1].label, outcomes[-1].message, len(outcomes), len(trials))
        if not ended:
            time.sleep(SECONDS_BETWEEN_POLLS)
    return outcomes


def queued_jobs() -> set[str]:
    """The ids of this user's jobs and array tasks that Slurm has queued or runs; empty without Slurm."""
    try:
        listing = subprocess.run(
            ["squeue", "--me", "--noheader", "--array", "--format=%i"],
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return set()
    return set(listing.stdout.split())


def _collect(job: Job[Outcome], folder: Path, trials: Sequence[Composed]) -> Outcome:
    """The outcome of an ended job: the trial's files first, then what the job returned, then its log's last words."""
    values = next(trial.values for trial in trials if TrialPaths.of(trial.values).folder == folder)
    finished = find_finished(values)
    if finished is not None:
        return outcome_of_results(folder, finished)
    if job.paths.result_pickle.exists():
        kind, value = pickle.loads(job.paths.result_pickle.read_bytes())  # submitit's own reader would ask sacct first
        if isinstance(value, Outcome):
            return value
        last = str(value).strip().splitlines()[-1] if str(value).strip() else kind
        return Outcome(folder, "failed", f"{last}; log: {job.paths.stderr}")
    return Outcome(
        folder, "failed", f"the process ended without a result (killed, or out of memory); log: {job.paths.stderr}"
    )


def _job(trial: Composed) -> TrialJob:
    return TrialJob(
        trial.values, trial.yaml, [entry for entry in sys.path if entry], os.environ.get("CUDA_VISIBLE_DEVICES")
    )


def _prepare_tracking(values: dict[str, Any]) -> None:
    """Make the tracker's tables and the experiment once, before many jobs would at the same time."""
    from gsbench.tracking import prepare

    prepare(values["tracking"], TrialPaths.of(values).runs, values["name"])
