"""A sweep in a real Slurm that runs out of time, is requeued and queued twice ends undisturbed.

Needs a running Slurm: ``scripts/slurm_one_node.sh start`` sets one up on this machine.
"""

import json
import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path
from shlex import split

import pytest

from tests.end_to_end.conftest import SMALL
from tests.helpers import read_json
from tests.processes import completed, wait_until

pytestmark = [pytest.mark.slurm, pytest.mark.slow]

SLOW = """
import os, time
from dataclasses import dataclass
from pathlib import Path
from gsbench.densify import ADC

@dataclass
class Slow(ADC):
    def after_step(self, step, gaussians, rng):
        time.sleep(float(os.environ.get("PAUSE", "0")))
        super().after_step(step, gaussians, rng)

@dataclass
class Broken(ADC):
    def refine(self, step, gaussians, rng):
        if Path(__file__).with_name("broken").exists():
            raise RuntimeError("it is broken")
        return super().refine(step, gaussians, rng)
"""
# seconds per iteration: a trial of 300 does not fit into Slurm's shortest time limit, a minute
PAUSE, LONG_PAUSE = "0.2", "0.4"
SWEEP = [*split("--config-dir conf -m"), *SMALL]
SWEEP += split("name=cluster densify=slow allow_targets=[slow] tracking=none")
TRAINING = "store/train/.*.partial/metrics.jsonl"
# Slurm sends its signal up to half a minute before the five seconds.
CLUSTER = split(
    "launch=slurm launch.timeout_min=1 launch.signal_seconds=5 launch.cpus_per_trial=1 "
    "launch.gpus_per_trial=0 launch.parallel=2"
)


@pytest.fixture(scope="session", autouse=True)
def slurm():
    if shutil.which("sinfo") is None:
        pytest.skip(
            "no Slurm here: scripts/slurm_one_node.sh start (root, Debian or Ubuntu) sets one up"
        )
    try:
        states = completed(split("sinfo -h -o %T"), timeout=120).stdout
    except (subprocess.SubprocessError, OSError, AssertionError) as error:
        pytest.skip(f"Slurm does not answer: {error}")
    if not any(state in states for state in ("idle", "mixed", "allocated")):
        pytest.skip(f"no node is ready: {states.strip() or 'none'}")


@pytest.fixture
def place(tmp_path):
    (tmp_path / "slow.py").write_text(SLOW)
    (tmp_path / "conf" / "densify").mkdir(parents=True)
    for name, target in (("slow", "slow.Slow"), ("broken", "slow.Broken")):
        text = f"defaults: [adc, _self_]\n_target_: {target}\nname: {name}\n"
        (tmp_path / "conf" / "densify" / f"{name}.yaml").write_text(text)
    return tmp_path


def models(runs):
    return {
        path.parent.name: path.read_bytes() for path in runs.glob("cluster/*/*/*/point_cloud.ply")
    }


def job_logs(runs):
    return "\n".join(path.read_text() for path in sorted(runs.glob(".jobs/cluster/*/*_log.*")))


def queue():
    return completed(split("squeue --me -h -r -o %i")).stdout.split()


def test_a_requeued_sweep_ends_with_the_models_of_an_undisturbed_one(place, gsbench, start):
    gsbench(*SWEEP, "seed=0,1", GSBENCH_RUNS=str(place / "whole"))

    runs = place / "runs"
    first = start(*SWEEP, "seed=0,1", *CLUSTER, PAUSE=PAUSE)
    wait_until(lambda: len(list(runs.glob(TRAINING))) == 2, 120, 0.2)
    queued = queue()
    assert len(queued) == 2
    time.sleep(3)
    # like a preemption: SIGTERM, then back to the queue
    completed(["scontrol", "requeue", queued[0]])
    first.send_signal(signal.SIGINT)
    output, _ = first.communicate(timeout=120)
    assert first.returncode == 130
    assert "the jobs stay in Slurm" in output

    second = start(*SWEEP, "seed=0,1", *CLUSTER, PAUSE=PAUSE)
    output, _ = second.communicate(timeout=280)
    logs = job_logs(runs)
    assert second.returncode == 0, output + logs
    # a job that has ended leaves the queue a little later
    wait_until(lambda: not set(queue()) & set(queued), 30, 0.5)
    assert sorted(models(runs)) == sorted(models(place / "whole"))
    assert models(runs) == models(place / "whole")
    assert len(list(runs.glob(".jobs/cluster/*/*_submission.sh"))) == 1, (
        "the trials were submitted a second time"
    )
    assert "Requeued job" in logs
    assert logs.count("stopping at iteration") >= 2, logs
    assert logs.count("going on from iteration") >= 2, logs


def states(gsbench):
    """The state of each arm by ``gsbench status``."""
    listing = json.loads(gsbench("status cluster --json", code=None).stdout)
    return {
        Path(trial["folder"]).parent.name.removeprefix("random-"): trial["state"]
        for trial in listing
    }


def wait_for_states(place, gsbench, **wanted):
    deadline = time.monotonic() + 240
    while (found := states(gsbench)) != wanted:
        assert time.monotonic() < deadline, (found, job_logs(place / "runs"))
        time.sleep(1)


def test_status_and_retry_manage_a_sweep_that_was_left_to_slurm(place, gsbench):
    (place / "broken").touch()
    sweep = [
        *SWEEP,
        "densify=slow,broken",
        *CLUSTER,
        "launch.timeout_min=10",
        "launch.parallel=1",
        "launch.wait=false",
    ]

    # The first trial must still train when the sweep is given again, also on a busy machine.
    first = gsbench(*sweep, PAUSE=LONG_PAUSE)
    assert re.fullmatch(r"Slurm job \d+: 2 trials; see gsbench status cluster\n", first.stdout)
    array = first.stdout.split()[2].rstrip(":")
    assert {job.split("_")[0] for job in queue()} == {array}
    wait_for_states(place, gsbench, slow="running", broken="queued")
    listing = gsbench("status cluster")
    assert f"Slurm job {array}_1, pending (" in listing.stdout
    assert "nothing to retry" in gsbench("retry cluster").stdout
    assert "2 trials: 1 queued, 1 running" in gsbench(*sweep, "--dry-run").stdout

    second = gsbench(*sweep, PAUSE=LONG_PAUSE)
    assert second.stdout == first.stdout
    assert len(list(place.glob("runs/.jobs/cluster/*/*_submission.sh"))) == 1, (
        "the trials were submitted a second time"
    )

    wait_for_states(place, gsbench, slow="done", broken="failed")
    listing = gsbench("status cluster", code=1)
    assert "it is broken" in listing.stdout
    (place / "broken").unlink()
    again = gsbench("retry cluster allow_targets=[slow]")
    assert re.fullmatch(r"Slurm job \d+: 1 trial; see gsbench status cluster\n", again.stdout)
    assert again.stdout.split()[2].rstrip(":") != array
    wait_for_states(place, gsbench, slow="done", broken="done")
    assert not list(place.glob("runs/cluster/*/*/*/.submitted.json"))


def test_a_cancelled_job_is_missing_and_can_run_without_slurm(place, gsbench):
    later = [*CLUSTER, "launch.wait=false", "launch.sbatch={begin: now+1hour}"]
    job = gsbench(*SWEEP, *later).stdout.split()[2].rstrip(":")
    assert states(gsbench) == {"slow": "queued"}
    completed(["scancel", job])
    wait_for_states(place, gsbench, slow="missing")
    ended = gsbench("status cluster", code=None)
    assert f"Slurm job {job} has ended, log: " in ended.stdout
    gsbench("retry cluster launch=serial allow_targets=[slow]")  # launch=serial has no launch.wait
    assert states(gsbench) == {"slow": "done"}


def test_failed_trial_and_killed_job_are_reported(place, gsbench, start):
    runs = place / "runs"
    slow = start(*SWEEP, "seed=0", *CLUSTER, "launch.timeout_min=10", PAUSE=PAUSE)
    bad = gsbench(*SWEEP, "seed=1,2", "densify.split_size=-1", *CLUSTER, code=2)
    assert "densify.split_size" in bad.stderr
    wait_until(lambda: list(runs.glob(TRAINING)), 120, 0.2)
    (folder,) = [
        path.parent for path in runs.glob("cluster/*/*/*/.submitted.json") if "seed0" in str(path)
    ]
    job = read_json(folder / ".submitted.json")["job"]
    holder = read_json(folder / ".lock.holder")
    status = gsbench("status cluster", code=None)
    assert "running" in status.stdout
    assert f"Slurm job {holder['slurm']}" in status.stdout
    os.kill(holder["pid"], signal.SIGKILL)
    output, _ = slow.communicate(timeout=120)
    assert slow.returncode == 1, output
    assert "ended without a result" in output
    assert job not in queue()
