"""The MLflow mirror: each metric arrives once in its experiment; a bad tracker harms no trial."""

import json
import logging
import subprocess
import sys
import threading
import time

import psutil
import pytest

from gsbench.system.locks import hold
from gsbench.tracking import Mirror, connect, ensure_experiment
from tests.helpers import read_json, write
from tests.processes import bytes_written
from tests.tracking.helpers import (
    STATE,
    begin_trial,
    begun_trial,
    child_environment,
    following,
    found_runs,
    free_port,
    options,
    run_of,
    write_trial,
)
from tests.tracking.servers import Listener
from tests.trials import trial_values

SECONDS = 240  # a limit for what never comes; a slow machine needs less


def wait_for_run(folder):
    """Wait until the trial's folder records its run."""
    deadline = time.monotonic() + SECONDS
    while "described" not in (read_json(folder / STATE) if (folder / STATE).exists() else {}):
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.mark.slow
def test_runs_of_failed_and_stopped_trials_say_so_and_are_continued(runs):
    folder, values = begun_trial(runs, seed=4)
    client = connect(None, runs)
    for error, status in ((KeyboardInterrupt(), "KILLED"), (RuntimeError("x"), "FAILED")):
        with pytest.raises(type(error)), following(options(), folder):  # noqa: PT012
            wait_for_run(folder)
            if status == "FAILED":  # as a trial does before its error is raised
                write(folder / "failed.json", {"message": "x"})
            raise error
        run = run_of(client, 4)
        assert run.info.status == status
    (folder / "failed.json").unlink()
    with following(options(), folder):
        write_trial(folder, values)
    run = run_of(client, 4)
    assert run.info.status == "FINISHED"


@pytest.mark.parametrize("uri", ["down", "not a database", "no such place", "nonsense"])
@pytest.mark.slow
def test_a_broken_tracker_harms_no_trial(uri, tmp_path, caplog):
    (tmp_path / "broken.db").write_text("this is no database" * 100)
    address = {
        "down": f"http://127.0.0.1:{free_port()}",
        "not a database": f"sqlite:///{tmp_path}/broken.db",
        "no such place": "sqlite:////proc/no/such/place.db",
        "nonsense": "gopher://x",
    }[uri]
    folder, values = begun_trial(tmp_path, uri=address)
    with following(options(address), folder):
        write_trial(folder, values)
    warnings = [
        record.getMessage() for record in caplog.records if record.levelno == logging.WARNING
    ]
    assert any(text.startswith("tracking: ") and "gsbench sync" in text for text in warnings)
    assert all("\n" not in text for text in warnings)
    assert (folder / "results.json").exists()


def test_a_slow_tracker_is_not_waited_for(tmp_path, caplog):
    others, threads = psutil.Process().children(), threading.active_count()
    values = trial_values(tmp_path)
    with Listener() as tracker:
        slow = options(f"http://127.0.0.1:{tracker.port}", patience=0.2)
        folder = begin_trial(values, slow["uri"], patience=0.2)
        with following(slow, folder):
            write_trial(folder, values)
            mine = threading.active_count() - threads - tracker.threads
    assert [record.getMessage().split(";")[0] for record in caplog.records] == [
        "tracking: MLflow is slow"
    ]
    # No thread is left that could hang at exit. An earlier one may have ended meanwhile.
    assert mine <= 0
    assert set(psutil.Process().children()) <= set(others)


def test_one_process_mirrors_all_trials_of_a_sweep(runs):
    """MLflow is loaded once, and no trial waits for it."""
    others = set(psutil.Process().children())
    with Mirror() as mirror:
        for seed in (9, 10, 11):
            folder, values = begun_trial(runs, seed)
            mirror.follow(folder, options())
            if seed < 11:  # the last never runs
                with hold(folder / ".lock", "a trial"):
                    write_trial(folder, values)
            assert len(set(psutil.Process().children()) - others) == 1
    shown = {
        run.data.tags["seed"]: run.info.status for run in found_runs(connect(None, runs), "tracked")
    }
    assert (shown["9"], shown["10"], shown["11"]) == ("FINISHED", "FINISHED", "KILLED")


@pytest.mark.slow
def test_the_trials_process_loads_no_mlflow(runs):
    """So MLflow cannot crash the process, and takes no memory beside a training."""
    folder, _ = begun_trial(runs, seed=8)
    code = (
        "import json, sys\nfrom pathlib import Path\nfrom gsbench.tracking import Mirror\noptions, "
        "folder = json.loads(sys.argv[1])\nwith Mirror() as mirror: mirror.follow(Path(folder), "
        "options)\nsys.exit('mlflow' in sys.modules)"
    )
    words = json.dumps([options(), str(folder)])
    done = subprocess.run(
        [sys.executable, "-c", code, words],
        env=child_environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
def test_a_killed_process_leaves_no_incomplete_database(tmp_path):
    """A process that is killed while it makes the tables does not stop the next one."""
    code = (
        "import sys; from pathlib import Path; from gsbench.tracking import connect; "
        "connect(None, Path(sys.argv[1]))"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], env=child_environment())
    # not its journal, which comes and goes
    while bytes_written(tmp_path, ".mlflow.db.tmp-*[0-9]") == 0:
        assert process.poll() is None
        time.sleep(0.001)
    process.kill()
    process.wait()
    assert not (tmp_path / "mlflow.db").exists()
    assert connect(None, tmp_path).search_experiments()
    assert (tmp_path / "mlflow.db").exists()


def test_deleted_experiment_is_restored(runs):
    client = connect(None, runs)
    first = ensure_experiment(client, "gone", runs)
    client.delete_experiment(first)
    assert ensure_experiment(client, "gone", runs) == first
    assert client.get_experiment(first).lifecycle_stage == "active"
