"""Running trials as tasks of a Slurm array job: submitted once, then awaited or left to Slurm."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbench.config.compose import Trial
from gsbench.errors import InputError
from gsbench.launch.jobs import (
    SECONDS_BETWEEN_POLLS,
    Outcome,
    TrialJob,
    collect,
    new_job_folder,
    say_last,
)
from gsbench.launch.states import (
    ask_queue,
    current_user,
    forget_submission,
    labels_of,
    read_queue,
    read_submission,
    record_submission,
)
from gsbench.system.locks import hold
from gsbench.words import counted

if TYPE_CHECKING:
    from submitit import Job, SlurmExecutor

log = logging.getLogger(__name__)

# in the folder of the jobs' output, so that two commands do not submit a trial twice
SUBMIT_LOCK = ".submit.lock"
SECONDS_BETWEEN_QUEUE_CHECKS = 20.0
# a job without a result is lost if it is missing in the queue so many times in a row
CHECKS_UNTIL_LOST = 2


def run_slurm(trials: Sequence[Trial]) -> list[Outcome]:
    """Run the trials in Slurm; those in its queue from an earlier command are not submitted again.

    Returns when all have ended; with ``launch.wait=false``, after submitting, with outcomes of
    status "queued".
    """
    values = trials[0].values
    executor = make_executor(values["launch"], new_job_folder(values))
    folder = Path(executor.folder)
    with hold(folder.parent / SUBMIT_LOCK, f"submitting trials of {values['name']}"):
        jobs = _submit(trials, executor)
    with suppress(OSError):  # nothing was submitted
        folder.rmdir()
    array = sorted({job.job_id.split("_")[0] for job in jobs.values()})
    if not values["launch"].get("wait", True):
        print(
            f"Slurm job {', '.join(array)}: {counted(len(jobs), 'trial')}; see gsbench status "
            f"{values['name']}"
        )
        return [Outcome(folder, "queued", job.job_id) for folder, job in jobs.items()]
    log.info(
        "%s in Slurm, job %s; logs: %s",
        counted(len(jobs), "trial"),
        ", ".join(array),
        folder.parent,
    )
    try:
        return _wait(jobs, trials)
    except KeyboardInterrupt:
        log.info(
            "the jobs stay in Slurm: the same command waits for them again, `scancel %s` ends them",
            " ".join(array),
        )
        raise


def make_executor(launch: dict[str, Any], folder: Path) -> SlurmExecutor:
    """The submitit executor for the settings ``launch``; raises InputError if Slurm is missing."""
    import submitit

    try:
        slurm = submitit.SlurmExecutor(folder, max_num_timeout=launch["max_requeues"])
    except RuntimeError:
        raise InputError(
            "launch=slurm: there is no srun here; start gsbench on a login node of the cluster"
        ) from None
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


def _submit(trials: Sequence[Trial], executor: SlurmExecutor) -> dict[Path, Job[Outcome]]:
    """The job of each trial by its folder: its job in the queue, else a task of a new array job."""
    import submitit

    folders = [trial.folder for trial in trials]
    queue = ask_queue(folders)
    if queue is None:
        raise InputError(
            "Slurm does not list its jobs (squeue failed), so nothing was submitted: try again "
            "later"
        )
    jobs: dict[Path, Job[Outcome]] = {}
    to_submit: dict[Path, Trial] = {}
    for folder, trial in zip(folders, trials, strict=True):
        submission = read_submission(folder)
        if submission and submission.job in queue:
            jobs[folder] = submitit.SlurmJob(Path(submission.log).parent, submission.job)
        else:
            to_submit[folder] = trial
    if to_submit:
        try:
            submitted = executor.submit_array(list(map(TrialJob, to_submit.values())))
        except Exception as error:
            raise InputError(
                f"Slurm refused the job: {' '.join(str(error).split())[:300]}"
            ) from error
        for folder, job in zip(to_submit, submitted, strict=True):
            record_submission(folder, job.job_id, job.paths.stderr)
            jobs[folder] = job
    return jobs


def _wait(jobs: dict[Path, Job[Outcome]], trials: Sequence[Trial]) -> list[Outcome]:
    outcomes: list[Outcome] = []
    labels, by_folder = labels_of(trials), {trial.folder: trial for trial in trials}
    submissions = filter(None, map(read_submission, jobs))
    users = {submission.user or current_user() for submission in submissions} | {current_user()}
    unseen = dict.fromkeys(jobs, 0)  # successive checks in which the queue did not list the job
    checked = time.monotonic()
    while jobs:
        ended = [folder for folder, job in jobs.items() if job.paths.result_pickle.exists()]
        if time.monotonic() - checked > SECONDS_BETWEEN_QUEUE_CHECKS:
            checked = time.monotonic()
            queue = read_queue(users)
            if queue is not None:  # while the scheduler does not answer, no job counts as lost
                for folder, job in jobs.items():
                    unseen[folder] = 0 if job.job_id in queue else unseen[folder] + 1
            lost = [folder for folder in jobs if unseen[folder] >= CHECKS_UNTIL_LOST]
            ended += [folder for folder in lost if folder not in ended]
        for folder in ended:
            outcomes.append(collect(jobs.pop(folder), by_folder[folder]))
            with suppress(OSError):
                forget_submission(folder)
            say_last(outcomes, labels)
        if not ended:
            time.sleep(SECONDS_BETWEEN_POLLS)
    return outcomes
