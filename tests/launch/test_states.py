"""The states of trials by their folders and Slurm's queue, and the estimate of a dry run."""

import os
import re
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from gsbench.config.compose import Trial
from gsbench.launch import states
from gsbench.launch.estimates import FinishedTrials, describe_plan
from gsbench.launch.record import record, remove
from gsbench.launch.states import (
    QueuedJob,
    current_user,
    read_queue,
    record_submission,
    states_of_experiment,
)
from gsbench.runs.commands import Command, PlannedTrial, append, read_history
from gsbench.system.locks import hold
from tests.helpers import read_json, refusal, write, write_lines
from tests.tracking.helpers import options
from tests.trials import bare_trial as trial
from tests.trials import write_results

LISTING = (
    "7_1|PENDING|Resources\n7_2|RUNNING|None\nslurm_load_jobs: retrying|soon\n7_3|SPECIAL_EXIT|\n"
)


def test_the_queue_is_asked_for_the_users_and_is_unknown_if_slurm_fails(monkeypatch):
    asked = []

    def answer(command, **how):
        asked.append((command, how["timeout"]))
        return SimpleNamespace(stdout=LISTING)

    monkeypatch.setattr(subprocess, "run", answer)
    queue = read_queue({"b", "a"})
    assert {name: (job.words, job.waits) for name, job in queue.items()} == {
        "7_1": ("pending (Resources)", True),
        "7_2": ("running", False),
        "7_3": ("special_exit", True),
    }
    ((command, limit),) = asked
    assert command == ["squeue", "--user=a,b", "--noheader", "--array", "--format=%i|%T|%r"]
    assert limit == 60
    for error in (FileNotFoundError(), subprocess.TimeoutExpired("squeue", 60)):
        monkeypatch.setattr(subprocess, "run", lambda *command, error=error, **how: fail(error))
        assert read_queue({"a"}) is None


def fail(error):
    raise error


def write_configuration(one, folder):
    write(folder / "config.yaml", one.values | {"tracking": options()})


def begun(runs, seed=0, step=0, **settings):
    """A trial with a folder, whose training has got to iteration ``step``."""
    one = trial(runs, seed, raster={"name": "cpu"}, **settings)
    write_configuration(one, one.folder)
    if step:
        write(one.folder / "building.json", {"stage": "train", "folder": str(one.folder)})
        write_lines(one.folder / "metrics.jsonl", [{"step": 1}, {"step": step}])
    return one


@pytest.mark.parametrize(
    "queue, state, note",
    [
        ({"7_1": QueuedJob("REQUEUED", "None")}, "queued", "in train at iteration 70 Slurm job 7_1, requeued"),
        ({"7_1": QueuedJob("RUNNING", "None")}, "running", "in train at iteration 70 Slurm job 7_1, running"),
        (None, "queued", "in train at iteration 70 Slurm job 7_1, Slurm does not answer"),
        ({"7_2": QueuedJob("RUNNING", "None")}, "partial", "stopped in train at iteration 70; Slurm job 7_1 has ended, log: a.log"),
    ],
)  # fmt: skip
def test_the_state_of_a_submitted_trial_is_that_of_its_job(
    tmp_path, monkeypatch, queue, state, note
):
    users = []
    monkeypatch.setattr(states, "read_queue", lambda names: users.append(names) or queue)
    one = begun(tmp_path, step=70)
    record_submission(one.folder, "7_1", Path("a.log"))
    for name, moment in ((".submitted.json", 20), ("config.yaml", 10)):
        os.utime(one.folder / name, (moment, moment))
    (found,) = states_of_experiment(tmp_path / "x")
    assert (found.state, found.note) == (state, note)
    assert found.since == (10 if state == "partial" else 20)
    assert users == [{current_user()}]
    assert describe_plan([one])[0].startswith(state)
    (one.folder / "config.yaml").unlink()
    if state == "partial":  # it was only planned
        assert states_of_experiment(tmp_path / "x") == []
        trials = {"/".join(one.folder.parts[-3:]): PlannedTrial(words=("a=1",))}
        append(tmp_path / "x", lambda _: Command(words=(), cwd="", time=5, trials=trials))
        (found,) = states_of_experiment(tmp_path / "x")
        assert (found.state, found.since) == ("missing", 5)
        assert found.note == "never started; Slurm job 7_1 has ended, log: a.log"


def test_states_have_the_time_of_the_file_that_tells_them(tmp_path, monkeypatch):
    monkeypatch.setattr(states, "read_queue", fail)  # nothing was submitted, so nobody is asked
    done, damaged, failed, running, stopped = (begun(tmp_path, seed) for seed in range(5))
    write_results(done.folder, done.values)
    (damaged.folder / "results.json").write_text("{")
    (failed.folder / "failed.json").write_text('{"message": "no luck"}')
    for one, name, moment in (
        (done, "results.json", 1),
        (damaged, "results.json", 2),
        (failed, "failed.json", 3),
        (stopped, "config.yaml", 4),
    ):
        os.utime(one.folder / name, (moment, moment))
    with hold(running.folder / ".lock", "a trial"):
        holder = running.folder / ".lock.holder"
        since = read_json(holder)["since"]
        seen = {state.folder: state for state in states_of_experiment(tmp_path / "x")}
        holder.unlink()
        unknown = {state.folder: state for state in states_of_experiment(tmp_path / "x")}
    found = [seen[one.folder] for one in (done, damaged, failed, running, stopped)]
    assert {one.state: one.since for one in found} == {
        "done": 1,
        "damaged": 2,
        "failed": 3,
        "running": since,
        "partial": 4,
    }
    assert "results.json is not JSON" in found[1].note
    assert [found[2].note, found[4].note] == ["no luck", "stopped"]
    assert unknown[running.folder].since is None
    assert unknown[running.folder].note == "process ? on ?"
    assert found[3].note.startswith(f"process {os.getpid()} on ")


def test_a_failed_trial_is_superseded_by_one_with_its_settings_that_got_further(tmp_path):
    def copied(one, name, message=""):
        folder = one.folder.with_name(name)
        write_configuration(one, folder)
        if message:
            write(folder / "failed.json", {"message": message})
        else:
            write_results(folder, one.values)
        return folder

    one, other = begun(tmp_path), begun(tmp_path, train={"iterations": 7})
    copied(one, "bbb-seed0")
    failed = {
        copied(one, "aaa-seed0", "old code"): "superseded",
        copied(one, "aaa-seed1", "another seed"): "failed",
        copied(other, "ccc-seed0", "other settings"): "failed",
        copied(one, "ddd-seed0", "no settings"): "failed",
    }
    (one.folder.with_name("ddd-seed0") / "config.yaml").write_text("{")
    found = {state.folder: state for state in states_of_experiment(tmp_path / "x")}
    assert {folder: found[folder].state for folder in failed} == failed
    note = found[one.folder.with_name("aaa-seed0")].note
    assert note == "bbb-seed0 is done, made by later code: old code"
    assert found[one.folder].state == "superseded"  # it was stopped, with the same settings
    assert found[other.folder].state == "partial"


def test_removed_trials_leave_the_plan_and_links_stay(tmp_path):
    gone, linked = (
        Trial(one.values | {"eval": {}}, ("seed=1",))
        for one in (begun(tmp_path), begun(tmp_path, 1))
    )
    record([gone, linked, begun(tmp_path, 2)], asks=False)  # the last one has no overrides
    assert set(read_history(tmp_path / "x").planned) == {gone.folder, linked.folder}
    remove(tmp_path / "x", [gone.folder])
    assert not gone.folder.exists()
    assert list(read_history(tmp_path / "x").planned) == [linked.folder]
    elsewhere = linked.folder.rename(tmp_path / "elsewhere")
    linked.folder.symlink_to(elsewhere)
    with refusal("is a link"):
        remove(tmp_path / "x", [linked.folder])
    assert list(elsewhere.iterdir())


def test_a_trial_whose_removal_fails_does_not_look_finished(tmp_path, monkeypatch):
    def fail(folder):
        raise OSError("busy")

    trial = begun(tmp_path)
    (trial.folder / "results.json").write_text("{}")
    monkeypatch.setattr("shutil.rmtree", fail)
    with pytest.raises(OSError, match="busy"):
        remove(tmp_path / "x", [trial.folder])
    assert trial.folder.is_dir()
    assert not (trial.folder / "results.json").exists()


def test_an_unfinished_trial_takes_the_rest_of_its_time(tmp_path):
    for seed, seconds in ((0, 299.0), (1, 599.0)):
        one = begun(tmp_path, seed)
        took = {"init": 1e6, "train": seconds, "evaluate": 1.0}
        write_results(one.folder, one.values, seconds=took)
    unused = begun(tmp_path, 2)
    write_results(unused.folder, unused.values, iterations=0, seconds={"train": 1e6})
    (begun(tmp_path, 3).folder / "results.json").write_text("{")
    half, over = begun(tmp_path, 4, step=75), begun(tmp_path, 5, step=200)
    assert FinishedTrials(tmp_path).estimate(half.values) == (pytest.approx(450), 2)
    lines = describe_plan([half, over])
    assert lines[-2] == "2 trials: 2 partial"
    assert lines[-1] == "time: about 4 min, estimated from 2 finished trials"  # 225 s
    whole = trial(tmp_path, 6, raster={"name": "cpu"})
    assert re.search(r"about 4 min, 3 at once,", describe_plan([half, whole], parallel=3)[-1])
    assert FinishedTrials(tmp_path).elsewhere(begun(tmp_path).files) is None


def test_an_estimate_is_of_the_same_scene_and_rasterizer_and_if_possible_densifier(tmp_path):
    def trained(name, **settings):
        train = {"iterations": 1000}
        named = {"densify": {"name": name}, "train": train, "raster": {"name": "cpu"}} | settings
        return trial(tmp_path, **named)

    for name, seconds in (("adc", 10.0), ("mcmc", 30.0)):
        one = trained(name, train={"iterations": 100})
        write_results(one.folder, one.values, seconds={"train": seconds})
        write_configuration(one, one.folder)
    estimate = FinishedTrials(tmp_path).estimate
    assert estimate(trained("adc").values) == (pytest.approx(100), 1)
    assert estimate(trained("none").values) == (pytest.approx(200), 2)
    for other in ({"raster": {"name": "reference"}}, {"scene": {"name": "a_scene", "width": 99}}):
        assert estimate(trained("adc", **other).values) == (0.0, 0)
