"""What users of MLflow expect of a run, also where many processes write to one tracker."""

import getpass
import shutil
import subprocess
import sys

import pytest

from gsbench.runs.trial_folder import TrialFolder
from gsbench.tracking import connect, default_uri
from tests.helpers import refusal
from tests.tracking.helpers import (
    begun_trial,
    child_environment,
    complete_runs,
    ended_trial,
    following,
    found_runs,
    history,
    mirror_command,
    mirror_trial,
    options,
    run_of,
    sync_trial,
    write_trial,
)
from tests.trials import trial_values

pytestmark = pytest.mark.slow


def mirrored(runs, seed, **more):
    """A client, and the run of a finished trial."""
    folder, values = ended_trial(runs, seed)
    (folder / "point_cloud.ply").write_text("ply\n")
    assert mirror_trial(options() | more, folder, values)
    client = connect(None, runs)
    run = run_of(client, seed)
    return client, run


def artifacts(client, run):
    return {item.path for item in client.list_artifacts(run.info.run_id)}


def test_a_trial_goes_to_the_tracker_in_the_environment(runs, tmp_path, monkeypatch):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", default_uri(runs))
    folder, values = begun_trial(tmp_path, seed=20)
    with following(options(), folder):
        write_trial(folder, values)
    assert not (tmp_path / "mlflow.db").exists()
    run = run_of(connect(None, runs), 20)
    assert run.info.status == "FINISHED"
    assert run.data.tags["mlflow.user"] == getpass.getuser()


def test_the_model_is_an_artifact_if_asked_for(runs):
    client, run = mirrored(runs, seed=23)
    assert "point_cloud.ply" not in artifacts(client, run)
    client, run = mirrored(runs, seed=24, model=True)
    assert "point_cloud.ply" in artifacts(client, run)


def test_a_moved_runs_folder_is_mirrored_again_from_its_files(runs, tmp_path):
    """MLflow keeps absolute addresses, so the copied database would write to the old folder."""
    mirrored(runs, seed=26)
    moved = tmp_path / "moved"
    shutil.copytree(runs, moved)
    values = trial_values(moved, seed=26)
    folder = TrialFolder.of(values).path
    with refusal(r"if this runs folder was moved, remove mlflow.db and mlartifacts there"):
        mirror_trial(options(), folder, values)
    (moved / "mlflow.db").unlink()
    shutil.rmtree(moved / "mlartifacts")
    # a process that has not opened the old one
    command = [sys.executable, "-m", "gsbench.cli", "sync", "tracked"]
    environment = child_environment() | {"GSBENCH_RUNS": str(moved)}
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=240, check=False
    )
    assert f"mirrored {TrialFolder(folder).label}" in done.stdout.splitlines(), done.stderr
    assert list((moved / "mlartifacts/tracked").rglob("results.json"))


JOBS = 8


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_eight_jobs_at_once_on_a_new_database(kind, tmp_path, request):
    """Each is a process that mirrors its trial, which is new to the tracker."""
    uri = None if kind == "sqlite" else request.getfixturevalue("postgresql")
    jobs = [
        subprocess.Popen(
            mirror_command(tmp_path, uri, seed),
            env=child_environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for seed in range(JOBS)
    ]
    outputs = [job.communicate(timeout=240)[0] for job in jobs]
    assert [job.returncode for job in jobs] == [0] * JOBS, outputs
    # A loaded machine may be too slow to send the last values of some; sync sends them.
    for seed in range(JOBS):
        sync_trial(tmp_path, uri, seed)
    client = connect(uri, tmp_path)
    for run in complete_runs(client, JOBS):
        own = {value for _, value in history(client, run.info.run_id, "train/l1")}
        assert own == {float(run.data.tags["seed"])}
    # and one parent run of their idea
    assert len(found_runs(client, "tracked")) == JOBS + 1
    assert found_runs(client, "Default") == []
