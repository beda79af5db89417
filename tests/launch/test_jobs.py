"""Running trials in this process, in processes of this machine and in Slurm, with stand-ins for
trials and jobs.

The files of a trial say how its job ended; the result that the job returned is not read.
"""

import json
import signal
import sys
from contextlib import contextmanager
from shlex import split
from types import SimpleNamespace

import pytest
import submitit

from gsbench.config.compose import Trial
from gsbench.errors import InputError, TrainingError
from gsbench.files import DiskFullError
from gsbench.launch import jobs
from gsbench.launch import slurm as slurm_jobs
from gsbench.launch.jobs import (
    Outcome,
    TrialJob,
    check_job_links,
    collect,
    new_job_folder,
    run_one,
)
from gsbench.launch.states import QueuedJob, current_user, read_submission, record_submission
from gsbench.runs.code import config_hash
from gsbench.runs.commands import digest_of
from gsbench.system.locks import BusyError
from gsbench.system.stopping import Stopped
from tests.helpers import refusal, write
from tests.trials import LOCAL, record_of, trial_values, write_results
from tests.trials import bare_trial as trial

SLURM = {
    **dict.fromkeys(("partition", "account", "qos", "mem_gb"), None),
    "name": "slurm",
    "parallel": 2,
    "timeout_min": 60,
    "wait": False,
    "cpus_per_trial": 4,
    "gpus_per_trial": 0,
    "signal_seconds": 90,
    "setup": [],
    "sbatch": {},
    "max_requeues": 5,
}


def job(folder, name):
    """Stands in for a job of submitit that has not ended."""
    paths = SimpleNamespace(result_pickle=folder / f"{name}.pkl", stderr=folder / "log")
    return SimpleNamespace(job_id=name, paths=paths)


def replace_trials(monkeypatch, run_trial):
    """Run ``run_trial`` instead of a trial."""
    stand_in = SimpleNamespace(run_trial=run_trial)
    monkeypatch.setitem(sys.modules, "gsbench.pipeline.trial", stand_in)


@contextmanager
def nothing(*arguments):
    yield


# ---- outcomes


def test_an_error_of_a_trial_becomes_its_outcome_unless_it_concerns_all(tmp_path, monkeypatch):
    def run_trial(trial, wait):
        raise raised

    replace_trials(monkeypatch, run_trial)
    failing = trial(tmp_path)
    log = failing.folder / "log.txt"
    for raised, message, bad_input in (  # noqa: B007 - the trial raises it
        (InputError("no photos"), "no photos", True),
        (TrainingError("nan"), "nan", False),
        (ValueError("a\nb"), f"ValueError: a; the traceback is in {log}", False),
    ):
        outcome = run_one(failing, wait=True)
        assert outcome == Outcome(failing.folder, "failed", message, bad_input)
    for raised in (BusyError("later"), DiskFullError("full"), KeyboardInterrupt()):
        with pytest.raises(type(raised)):
            run_one(failing, wait=True)


def test_a_single_trial_waits_for_another_process_and_several_are_counted(
    tmp_path, monkeypatch, logged
):
    waits = []

    def run_trial(trial, wait):
        waits.append(wait)
        return write_results(trial.folder, trial.values, metrics={"psnr": 20.456, "ssim": 0.5})

    replace_trials(monkeypatch, run_trial)
    trials = [trial(tmp_path, seed) for seed in (0, 1)]
    (outcome,) = jobs.run_serial(trials[:1])
    assert outcome == Outcome(trials[0].folder, "done", "psnr 20.46  ssim 0.5")
    assert not logged.messages
    jobs.run_serial(trials)
    assert waits == [True, False, False]
    assert logged.messages == [f"{k} of 2: {trials[k - 1].files.label}" for k in (1, 2)]


def collected(runs, failure="", results=""):
    """The outcome of a job that left a pickled result, which is not read."""
    one, ended = trial(runs, launch=SLURM), job(runs, "1_0")
    one.folder.mkdir(parents=True, exist_ok=True)
    if failure:
        (one.folder / "failed.json").write_text(failure)
    if results:
        lacks = {"awaited": ["flip"], "hashes": {"config": config_hash(one.values)}}
        (one.folder / "table.csv").write_text("as it was")
        record = record_of(one.values, **lacks)
        one.files.write_finished(one.values, record, published=[one.folder / "table.csv"])
        if results == "changed":
            (one.folder / "table.csv").unlink()
    ended.paths.result_pickle.write_bytes(b"cos\nmkdir\n(S'exploded'\ntR.")
    return collect(ended, one)


def test_the_files_of_a_trial_tell_how_its_job_ended(tmp_path):
    log = tmp_path / "log"
    outcome = collected(tmp_path)
    assert outcome.status == "failed"
    assert outcome.message.endswith(f"without a result (killed, or out of memory); log: {log}")
    log.write_text("loading\nRuntimeError: no luck\n")
    assert "; its last lines: RuntimeError: no luck; log:" in collected(tmp_path).message
    failure = json.dumps({"message": "no scene\nat all", "bad_input": True})
    outcome = collected(tmp_path, failure)
    assert (outcome.message, outcome.bad_input) == (f"no scene; log: {log}", True)
    # what it lacks could not be computed a moment ago either
    assert collected(tmp_path, results="kept").status == "done"
    (trial(tmp_path).folder / "failed.json").unlink()
    outcome = collected(tmp_path, results="changed")
    assert outcome.status == "failed"
    assert "its results no longer hold (" in outcome.message


# ---- processes of this machine


@pytest.fixture
def machine(monkeypatch):
    """What a job did to its process, with stand-ins for its trial and for all of that."""
    did = {}

    def run_one(trial, wait):
        did["trial"], did["wait"] = trial, wait
        return did["outcome"]

    @contextmanager
    def take_slot(runs, count):
        did["slots"] = runs, count
        yield 5

    def note(name):
        return lambda *arguments: did.update({name: arguments})

    monkeypatch.setattr(jobs, "run_one", run_one)
    monkeypatch.setattr(jobs, "take_slot", take_slot)
    monkeypatch.setattr(jobs, "Mirror", lambda trials: note("mirrored")(*trials) or nothing())
    for name in split("adopt_modules set_up_logging assign_gpu assign_threads"):
        monkeypatch.setattr(jobs, name, note(name))
    monkeypatch.setattr(
        jobs, "stop_on_signals", lambda signals: note("signals")(*signals) or nothing()
    )
    monkeypatch.setattr(sys, "path", ["own", "both"])
    return did


def test_a_local_job_takes_a_slot_and_its_share_of_the_machine(tmp_path, machine, capsys):
    machine["outcome"] = Outcome(tmp_path, "failed", "no luck")
    one = trial(tmp_path)
    job = TrialJob(one, ["theirs", "both"], {"mine": "/there"}, "6,7")
    assert job() is machine["outcome"]
    assert sys.path == ["theirs", "both", "own"]
    assert (machine["trial"].values, machine["wait"]) == (one.values, True)
    assert machine["adopt_modules"] == ({"mine": "/there"},)
    assert machine["set_up_logging"] == ()
    assert machine["slots"] == (tmp_path, 2)
    assert machine["assign_gpu"] == (5, "6,7")
    assert machine["assign_threads"] == (3, 2)
    assert machine["mirrored"] == ()  # the sweep's own process mirrors
    assert signal.SIGINT not in machine["signals"]  # it belongs to that process, too
    assert capsys.readouterr().err == "no luck\n"
    del machine["assign_gpu"]
    TrialJob(Trial(one.values | {"device": "cuda:1"}, ()), [], {}, None)()
    assert "assign_gpu" not in machine


def test_a_job_in_slurm_mirrors_itself_and_is_forgotten_at_its_end(tmp_path, machine, capsys):
    machine["outcome"] = Outcome(tmp_path, "done", "psnr 1")
    record_submission(tmp_path, "7_1", tmp_path / "log")
    TrialJob(trial(tmp_path, launch=SLURM), [], {}, None)()
    assert read_submission(tmp_path) is None
    assert not {"slots", "assign_gpu"} & set(machine)
    assert machine["assign_threads"] == (3, 2)
    assert len(machine["mirrored"]) == 1
    assert signal.SIGINT in machine["signals"]
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("name", ["SIGTERM", "SIGUSR2"])
def test_a_stopped_job_ends_and_is_requeued_when_its_time_is_up(
    tmp_path, machine, monkeypatch, name
):
    requeued = []
    handlers = {signal.SIGUSR2: lambda *arguments: requeued.append(arguments)}
    monkeypatch.setattr(signal, "getsignal", handlers.get)
    number = getattr(signal, name)

    def stop(trial, wait):
        raise Stopped(number)

    monkeypatch.setattr(jobs, "run_one", stop)
    job = TrialJob(trial(tmp_path, launch=SLURM), [], {}, None)
    with pytest.raises(SystemExit) as ended:
        job()
    assert ended.value.code == 128 + number
    assert requeued == ([(number, None)] if name == "SIGUSR2" else [])
    assert job.checkpoint().function is job


def test_a_job_whose_code_changed_since_its_command_fails_and_runs_nothing(
    tmp_path, machine, monkeypatch
):
    monkeypatch.setattr(jobs, "run_one", lambda *arguments, **named: pytest.fail("it ran"))
    one = trial(tmp_path, launch=SLURM)
    outcome = TrialJob(one, [], {}, None, f"{digest_of(one.values)}-before")()
    assert (outcome.status, outcome.bad_input) == ("failed", True)
    assert outcome.message == "code changed since the command; give it again"


class Jobs:
    """Stands in for submitit's executor; ``steps`` says after how many questions each job ends."""

    def __init__(self, folder, steps):
        self.folder, self.steps, self.parameters = folder, list(steps), {}
        self.seeds = []
        self.sent = {}
        self.running = self.most = 0

    def update_parameters(self, **parameters):
        self.parameters |= parameters

    def submit(self, job):
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        seed, left = job.trial.values["seed"], self.steps[len(self.seeds)]
        self.seeds.append(seed)
        self.running += 1
        self.most = max(self.most, self.running)

        def done():
            nonlocal left
            left -= 1
            if left < 0:
                raise KeyboardInterrupt
            self.running -= left == 0
            return left == 0

        def send_signal(number):
            self.sent[seed] = number

        process = SimpleNamespace(poll=lambda: None if seed % 2 else 0, send_signal=send_signal)
        paths = SimpleNamespace(stderr=self.folder / "log")
        return SimpleNamespace(done=done, paths=paths, _process=process)


@pytest.mark.parametrize("minutes, limit", [(None, 365 * 24 * 60), (30, 30)])
def test_local_jobs_run_as_many_at_once_as_asked(tmp_path, monkeypatch, logged, minutes, limit):
    pauses = []
    monkeypatch.setattr("time.sleep", pauses.append)
    executor = Jobs(tmp_path, [3, 1, 2, 1])
    monkeypatch.setattr(submitit, "LocalExecutor", lambda folder: executor)
    launch = LOCAL | {"timeout_min": minutes}
    scenes = split("a a b b")
    trials = [trial(tmp_path, seed, launch, scene={"name": scenes[seed]}) for seed in range(4)]
    outcomes = jobs.run_local(trials)
    # one of each scene first, and a trial begins as soon as another ends
    assert executor.seeds == [0, 2, 1, 3]
    assert executor.most == 2
    assert pauses == [1.0]  # whenever none has ended
    assert [one.folder for one in outcomes] == [trials[k].folder for k in (2, 0, 1, 3)]
    assert executor.parameters == {"timeout_min": limit}
    assert logged.messages[0] == ("4 trials, 2 at once; to see how far they are: gsbench status x")
    assert logged.messages[1].startswith(f"{trials[2].files.label}: the process ended without")
    assert [line.endswith(f"({k} of 4)") for k, line in enumerate(logged.messages[1:], 1)] == [
        True
    ] * 4


def test_ctrl_c_is_passed_on_to_the_processes_that_still_run(tmp_path, monkeypatch):
    executor = Jobs(tmp_path, [0, 9])
    monkeypatch.setattr(submitit, "LocalExecutor", lambda folder: executor)
    with pytest.raises(KeyboardInterrupt):
        jobs.run_local([trial(tmp_path, seed) for seed in (1, 2)])
    assert executor.sent == {1: signal.SIGTERM}  # the process of seed 2 has ended


def test_submitits_link_is_removed_and_any_other_link_is_refused(tmp_path):
    values = trial_values(tmp_path, name="cluster")
    folder = tmp_path / ".jobs/cluster"
    script = new_job_folder(values) / "2_submission.sh"
    script.write_text("#!/bin/bash\n")
    left = script.with_name(".submission_file_aaa46bf3.sh")
    left.symlink_to(script)
    assert new_job_folder(values).parent == folder
    assert not left.is_symlink()
    assert script.exists()
    (folder / "2_0_0_log.out").symlink_to(tmp_path / "elsewhere")
    with refusal(r"2_0_0_log\.out is a link"):
        new_job_folder(values)
    (tmp_path / ".jobs/other").symlink_to(tmp_path)
    with refusal(r"other is a link"):
        new_job_folder(trial_values(tmp_path, name="other"))


def test_through_a_link_no_file_of_another_folder_is_removed(tmp_path):
    kept = tmp_path / "elsewhere/.submission_file_aaa46bf3.sh"
    kept.parent.mkdir()
    kept.symlink_to(tmp_path)
    runs = tmp_path / "runs"
    runs.mkdir()
    (runs / ".hydra").symlink_to(kept.parent)
    with refusal(r"hydra is a link"):
        check_job_links(runs, runs / ".hydra")
    assert kept.is_symlink()


def test_no_job_unpickles_what_a_strangers_runs_folder_has(tmp_path):
    values = trial_values(tmp_path, name="theirs")
    planted = write(tmp_path / ".jobs/theirs/17_submitted.pkl", b"code")
    first, second = new_job_folder(values), new_job_folder(values)
    assert first != second
    assert not list(first.iterdir())
    assert {first.parent, second.parent} == {planted.parent}


# ---- Slurm


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """Stands in for Slurm: ``queue`` lists the jobs, ``submitted`` has the seeds of new ones."""
    state = SimpleNamespace(queue={}, submitted=[], error=None, asked=[])

    def submit_array(tasks):
        if state.error:
            raise state.error
        state.submitted += [task.trial.values["seed"] for task in tasks]
        return [job(tmp_path, f"9_{number}") for number, _ in enumerate(tasks)]

    executor = SimpleNamespace(folder=tmp_path, submit_array=submit_array)
    monkeypatch.setattr(slurm_jobs, "make_executor", lambda launch, folder: executor)
    monkeypatch.setattr(slurm_jobs, "ask_queue", lambda folders: state.queue)
    monkeypatch.setattr(submitit, "SlurmJob", job)
    return state


def test_trials_in_the_queue_are_not_submitted_again(tmp_path, slurm, capsys):
    trials = [trial(tmp_path, seed, SLURM) for seed in range(3)]
    slurm.queue = {"7_1": QueuedJob("RUNNING", "None")}
    for seed, name in ((0, "7_0"), (1, "7_1")):  # the first has left the queue
        record_submission(trials[seed].folder, name, tmp_path / "old")
    outcomes = slurm_jobs.run_slurm(trials)
    assert slurm.submitted == [0, 2]
    assert {(one.folder, one.status, one.message) for one in outcomes} == {
        (trials[0].folder, "queued", "9_0"),
        (trials[1].folder, "queued", "7_1"),
        (trials[2].folder, "queued", "9_1"),
    }
    found = read_submission(trials[2].folder)
    assert (found.job, found.log, found.user) == ("9_1", str(tmp_path / "log"), current_user())
    assert capsys.readouterr().out == "Slurm job 7, 9: 3 trials; see gsbench status x\n"


def test_without_a_listing_or_a_scheduler_nothing_counts_as_submitted(tmp_path, slurm):
    one = trial(tmp_path, launch=SLURM)
    slurm.queue = None
    with refusal("nothing was submitted"):
        slurm_jobs.run_slurm([one])
    slurm.queue, slurm.error = {}, RuntimeError("no such\npartition " + 300 * "x")
    with pytest.raises(InputError) as refused:
        slurm_jobs.run_slurm([one])
    assert str(refused.value) == "Slurm refused the job: no such partition " + 282 * "x"
    assert (read_submission(one.folder), slurm.submitted) == (None, [])


def test_a_command_waits_for_slurm_unless_told_otherwise(tmp_path, slurm, monkeypatch, logged):
    launch = {key: value for key, value in SLURM.items() if key != "wait"}
    one = trial(tmp_path, launch=launch)
    monkeypatch.setattr(slurm_jobs, "_wait", lambda waiting, trials: (list(waiting), trials))
    assert slurm_jobs.run_slurm([one]) == ([one.folder], [one])

    def stop(waiting, trials):
        raise KeyboardInterrupt

    monkeypatch.setattr(slurm_jobs, "_wait", stop)
    with pytest.raises(KeyboardInterrupt):
        slurm_jobs.run_slurm([one])
    assert logged.messages[0] == f"1 trial in Slurm, job 9; logs: {tmp_path.parent}"
    assert logged.messages[-1].endswith("`scancel 9` ends them")


def test_settings_become_options_of_slurm(tmp_path, monkeypatch):
    given = {}

    class Executor:
        def __init__(self, folder, max_num_timeout):
            given.update(folder=folder, requeues=max_num_timeout)

        def update_parameters(self, **parameters):
            given.update(parameters)

    monkeypatch.setattr(submitit, "SlurmExecutor", Executor)
    expected = {
        "folder": tmp_path,
        "requeues": 5,
        "job_name": "gsbench",
        "time": 60,
        "cpus_per_task": 4,
        "signal_delay_s": 90,
        "array_parallelism": 2,
    }
    slurm_jobs.make_executor(SLURM, tmp_path)
    assert given == expected
    more = {"partition": "p", "account": "a", "qos": "q", "setup": ["module load"]}
    sizes = {"gpus_per_trial": 1, "mem_gb": 16, "sbatch": {"constraint": "a100"}}
    slurm_jobs.make_executor(SLURM | more | sizes, tmp_path)
    assert given == expected | more | {
        "gpus_per_node": 1,
        "mem": "16GB",
        "additional_parameters": {"constraint": "a100"},
    }

    def missing(*arguments, **named):
        raise RuntimeError

    monkeypatch.setattr(submitit, "SlurmExecutor", missing)
    with refusal("there is no srun here"):
        slurm_jobs.make_executor(SLURM, tmp_path)


def test_waiting_ends_with_the_last_job_and_counts_jobs_that_left_the_queue(
    tmp_path, monkeypatch, logged
):
    """The first job wrote a result, the second is listed once more and then missing twice."""
    queues = iter([{"7_1"}, None, set(), {"7_1"}, set(), set()])
    asked = []
    monkeypatch.setattr(slurm_jobs, "read_queue", lambda users: asked.append(users) or next(queues))
    pauses = []
    monkeypatch.setattr("time.sleep", pauses.append)
    monkeypatch.setattr(slurm_jobs, "SECONDS_BETWEEN_QUEUE_CHECKS", -1)
    trials = [trial(tmp_path, seed, SLURM) for seed in (0, 1)]
    waiting = {one.folder: job(tmp_path, f"7_{k}") for k, one in enumerate(trials)}
    record_submission(trials[1].folder, "7_1", tmp_path / "log")
    submitted = trials[1].folder / ".submitted.json"
    submitted.write_text(submitted.read_text().replace(f'"{current_user()}"', '"ada"'))
    (tmp_path / "7_0.pkl").write_bytes(b"")
    outcomes = slurm_jobs._wait(waiting, trials)
    assert [outcome.folder for outcome in outcomes] == [trial.folder for trial in trials]
    assert list(queues) == []
    assert pauses == [1.0] * 4
    assert asked == [{"ada", current_user()}] * 6
    assert not submitted.exists()
    said = logged.messages
    assert ["seed 0" in said[0], "seed 1" in said[1]] == [True, True]
    assert [line.endswith(f"({k} of 2)") for k, line in enumerate(said, 1)] == [True, True]
