"""A complete trial ends with exit code 0 and at most one warning, whatever its tracker does."""

import os
import signal
import subprocess
import sys
import urllib.request
from contextlib import ExitStack, contextmanager, suppress
from shlex import split
from urllib.parse import urlsplit

import psutil
import pytest

from gsbench.tracking import connect, ensure_experiment
from gsbench.tracking.mlflow_sink import SETTINGS
from tests.end_to_end.conftest import SMALL
from tests.helpers import read_json
from tests.processes import completed, heed_interrupts, wait_until
from tests.tracking.helpers import (
    begin_trial,
    child_environment,
    complete_runs,
    free_port,
    mirror_command,
    sync_trial,
    write_trial,
)
from tests.tracking.servers import Gate, Listener
from tests.trials import trial_values

pytestmark = pytest.mark.slow
# A limit for programs that hang; a slow machine needs less.
SECONDS = 240
PATIENCE = 4.0
TINY = split("train.iterations=20 scene.views=8 init.count=500 eval.lpips=[] eval.flip=false")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return tmp_path_factory.mktemp("bad-trackers")


def start(runs, *words):
    kept = {
        key: value
        for key, value in child_environment().items()
        if not key.startswith(("GSBENCH_", "MLFLOW_"))
    }
    settings = [*SMALL, *TINY, f"tracking.patience_seconds={PATIENCE}", *words]
    return subprocess.Popen(
        [sys.executable, "-m", "gsbench.cli", *settings],
        cwd=runs,
        env=kept | {"GSBENCH_RUNS": str(runs)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def check_complete(runs, name, code, errors):
    assert code == 0, errors
    said = [line for line in errors.splitlines() if "tracking" in line or "MLflow" in line]
    assert len(said) == 1, errors
    assert "gsbench sync" in said[0]
    (results,) = (runs / name).glob("**/results.json")
    assert read_json(results)["status"] == "complete"


@pytest.mark.parametrize(
    "kind", ["refuses", "never answers", "answers after a minute", "hangs up", "postgresql"]
)
def test_a_trial_with_a_bad_tracker_is_complete_and_prints_one_line(kind, runs):
    with ExitStack() as stack:
        port = free_port()
        if kind in ("never answers", "postgresql"):
            port = stack.enter_context(Listener()).port
        elif kind == "answers after a minute":
            port = stack.enter_context(Listener(seconds=60)).port
        elif kind == "hangs up":
            port = stack.enter_context(Gate(free_port())).port
        uri = f"http://127.0.0.1:{port}"
        if kind == "postgresql":
            uri = f"postgresql+psycopg2://x@127.0.0.1:{port}/x"
        name = kind.replace(" ", "_")
        program = start(runs, f"name={name}", f"tracking.uri={uri}")
        _, errors = program.communicate(timeout=SECONDS)
    check_complete(runs, name, program.returncode, errors)


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_mirror_outlives_a_trial_that_is_ended_while_its_tracker_hangs(signum, runs):
    name = f"ended_by_{signum}"
    with Listener() as tracker:
        address = f"tracking.uri=http://127.0.0.1:{tracker.port}"
        program = start(runs, f"name={name}", address, "train.iterations=100000")
        mirrors = mirrors_of(program)
        wait_until(
            lambda: bool(tracker.connections) and any((runs / name).glob("**/building.json"))
        )
        program.send_signal(signum)
        _, errors = program.communicate(timeout=SECONDS)
        gone, alive = psutil.wait_procs(mirrors, timeout=SECONDS)
    assert not alive
    assert len(gone) == 1
    assert program.returncode == (128 + signum if signum != signal.SIGKILL else -signum), errors
    assert "Traceback" not in errors


def test_sync_can_be_stopped_while_the_tracker_hangs(runs):
    values = trial_values(runs, name="synced")
    with Listener() as tracker:
        address = f"postgresql+psycopg2://x@127.0.0.1:{tracker.port}/x"
        folder = begin_trial(values, address)
        write_trial(folder, values)
        program = subprocess.Popen(
            [sys.executable, "-m", "gsbench.cli", "sync", "synced", "--uri", address],
            env=child_environment() | {"GSBENCH_RUNS": str(runs)},
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=heed_interrupts,
        )
        wait_until(lambda: bool(tracker.connections))
        program.send_signal(signal.SIGINT)
        _, errors = program.communicate(timeout=SECONDS)
    assert program.returncode == 128 + signal.SIGINT
    assert "Traceback" not in errors


def mirrors_of(program):
    """The mirror processes of a program, once there are any."""
    found = []

    def look():
        with suppress(psutil.NoSuchProcess):
            children = psutil.Process(program.pid).children(recursive=True)
            found[:] = [child for child in children if "sync" in child.cmdline()]
        return bool(found)

    wait_until(look)
    return found


@pytest.fixture(params=["http", "postgresql"])
def tracker(request, tmp_path_factory):
    """A gate before a working tracker, and the address of the tracker through the gate."""
    with ExitStack() as stack:
        if request.param == "http":
            port = stack.enter_context(mlflow_server(tmp_path_factory.mktemp("server")))
        else:
            port = urlsplit(request.getfixturevalue("postgresql")).port
        gate = stack.enter_context(Gate(port))
        address = f"127.0.0.1:{gate.port}"
        database = f"postgresql+psycopg2://gsbench@{address}/postgres"
        yield gate, f"http://{address}" if request.param == "http" else database


def test_sync_completes_runs_whose_tracker_was_lost_at_any_moment(tracker, tmp_path, monkeypatch):
    """The tracker is lost early, late and in between; ``sync`` completes one run, each value once.

    The database is told to end a transaction that was cut off, which would lock its rows.
    """
    gate, uri = tracker
    # made before, since it may take longer than the mirroring
    ensure_experiment(connect(uri, tmp_path), "tracked", tmp_path)
    seconds = SETTINGS["PGOPTIONS"].replace("60s", "3s")
    assert seconds != SETTINGS["PGOPTIONS"]
    monkeypatch.setenv("PGOPTIONS", seconds)
    gate.passed = 0
    assert "tracking" not in mirror_a_trial(tmp_path, uri, seed=0, patience=SECONDS)
    whole = gate.passed
    for seed, (share, then) in enumerate([(0.2, "hang"), (0.5, "close"), (0.8, "hang")], 1):
        gate.passed, gate.then, gate.limit = 0, then, int(share * whole)
        assert "gsbench sync" in mirror_a_trial(tmp_path, uri, seed, patience=PATIENCE)
        gate.mended()
        sync_trial(tmp_path, uri, seed)
    complete_runs(connect(uri, tmp_path), 4)


def mirror_a_trial(runs, uri, seed, patience):
    """Mirror a trial in a process of its own, which must succeed; returns its stderr."""
    words = mirror_command(runs, uri, seed, patience)
    done = completed(words, env=child_environment(), timeout=SECONDS)
    return done.stderr


@contextmanager
def mlflow_server(folder):
    port = free_port()
    words = (
        f"server --backend-store-uri sqlite:///{folder}/mlflow.db --host 127.0.0.1 --port {port}"
    )
    more = f"--workers 1 --artifacts-destination {folder}"
    command = [sys.executable, "-m", "mlflow", *split(f"{words} {more}")]
    lean = {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    environment = os.environ | lean
    server = subprocess.Popen(command, env=environment, start_new_session=True, **silent)

    def answers():
        with (
            suppress(OSError),
            urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=5) as answer,
        ):
            return bool(answer.status == 200)
        return False

    try:
        wait_until(answers)
        yield port
    finally:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait()
