"""Many processes, one tracker: nothing is lost, doubled or mixed."""

import subprocess

import pytest

from gsbench.runs.trial_folder import TrialFolder
from gsbench.tracking import connect
from tests.tracking.helpers import (
    child_environment,
    found_runs,
    history,
    mirror_command,
    mirror_trial,
    options,
    trial_runs,
)
from tests.trials import STEPS, trial_values

pytestmark = pytest.mark.slow

JOBS = 8


def run_jobs(runs, uri):
    """Run eight trials at once, each in its own process, all new to the tracker."""
    commands = [mirror_command(runs, uri, seed) for seed in range(JOBS)]
    jobs = [
        subprocess.Popen(
            command,
            env=child_environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for command in commands
    ]
    outputs = [job.communicate(timeout=240)[0] for job in jobs]
    assert [job.returncode for job in jobs] == [0] * JOBS, outputs
    # A loaded machine may be too slow to send the last values of some; sync sends them.
    for seed in range(JOBS):
        values = trial_values(runs, seed)
        mirror_trial(options(uri), TrialFolder.of(values).path, values)


def check_jobs(client):
    found = trial_runs(client)
    assert sorted(run.data.tags["seed"] for run in found) == [str(seed) for seed in range(JOBS)]
    for run in found:
        seed = int(run.data.tags["seed"])
        assert run.info.status == "FINISHED"
        assert history(client, run.info.run_id, "train/loss") == [
            (i, 1 / i) for i in range(1, STEPS + 1)
        ]
        assert {value for _, value in history(client, run.info.run_id, "train/l1")} == {float(seed)}
        assert run.data.metrics["eval/gaussians"] == 10 + seed
    # and one parent run of their idea
    assert len(found_runs(client, "tracked")) == JOBS + 1
    assert found_runs(client, "Default") == []


def test_eight_jobs_at_once_on_a_new_sqlite_database(tmp_path):
    run_jobs(tmp_path, None)
    check_jobs(connect(None, tmp_path))


def test_eight_jobs_at_once_on_a_new_postgresql_database(tmp_path, postgresql):
    run_jobs(tmp_path, postgresql)
    check_jobs(connect(postgresql, tmp_path))
