"""Verbs that serve pages end all their processes and import no module of the current folder."""

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import suppress
from pathlib import Path
from shlex import split
from types import SimpleNamespace

import psutil
import pytest
import torch

from gsbench.runs.experiments import make_home
from gsbench.tracking import connect, sync
from gsbench.verbs import servers
from tests.helpers import write
from tests.tracking.helpers import ended_trial

SECONDS = 120


@pytest.mark.slow
@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGINT])
def test_all_processes_of_the_dashboard_end_and_none_imports_from_the_current_folder(
    tmp_path, signum
):
    (tmp_path / "runs").mkdir()
    connect(None, tmp_path / "runs")
    (tmp_path / "yaml.py").write_text(f"open({str(tmp_path / 'exploded')!r}, 'w')\n")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = os.environ | {"GSBENCH_RUNS": str(tmp_path / "runs")}
    command = [sys.executable, *split(f"-P -m gsbench.cli ui --port {port}")]
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL
    ) as process:
        deadline = time.monotonic() + SECONDS
        while time.monotonic() < deadline:
            with (
                suppress(OSError),
                urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=5) as answer,
            ):
                assert answer.status == 200
                break
            time.sleep(0.2)
        family = psutil.Process(process.pid).children(recursive=True)
        assert len(family) >= 2
        process.send_signal(signum)
        assert process.wait(timeout=30) == 0
    assert not [
        child for child in family if child.is_running() and child.status() != psutil.STATUS_ZOMBIE
    ]
    assert not (tmp_path / "exploded").exists()


# ---- gsbench ui


def test_ui_needs_a_database(runs, refused):
    assert "no MLflow database" in refused("ui")


def test_ui_serves_on_this_machine_only(monkeypatch):
    commands = []

    class Server:
        def __init__(self, command, cwd, env):
            commands.append(command)
            assert env["MLFLOW_SERVER_ENABLE_JOB_EXECUTION"] == "false"
            assert not list(Path(cwd).iterdir())

        def wait(self):
            return 0

    monkeypatch.setattr(subprocess, "Popen", Server)
    monkeypatch.setattr(servers, "end_descendants", lambda: None)
    assert servers.serve("sqlite:///x.db", 1234) == 0
    assert commands[0][commands[0].index("--host") + 1] == "127.0.0.1"


@pytest.fixture
def served(runs, monkeypatch):
    """The servers that ``ui`` would start."""
    served = []
    write(runs / "mlflow.db", b"")
    monkeypatch.setattr(servers, "show_ideas", lambda home, uri: f"{len(home.name)}")
    monkeypatch.setattr(servers, "serve", lambda uri, port: served.append((uri, port)) or 0)
    monkeypatch.setattr(servers, "_serves", lambda *_: False)
    return served


LOCAL = "http://127.0.0.1:5000"


def test_the_dashboard_shows_the_only_experiment_or_the_one_named(runs, served, said):
    uri = f"sqlite:///{runs / 'mlflow.db'}"
    assert said("ui").splitlines()[0].split() == ["dashboard", LOCAL]
    assert served == [(uri, 5000)]
    for name in ("ab", "cde"):
        make_home(runs / name)
    first, *_ = said("ui --port 81").splitlines()
    assert first.split() == ["dashboard", "http://127.0.0.1:81"]  # one of two was not chosen
    served.clear()
    pages = said("ui cde").split()
    assert pages[:3] == ["ideas", f"{LOCAL}/#/experiments/3/runs", "bars"]
    assert served == [(uri, 5000)]


def test_the_dashboard_gets_first_what_it_lacks(runs, said, monkeypatch):
    ended_trial(runs, name="mine", enabled=False)
    monkeypatch.setattr(servers, "serve", lambda uri, port: 0)
    assert "ideas" in said("ui")
    client = connect(None, runs)
    found = client.get_experiment_by_name("mine")
    kinds = {run.data.tags["kind"] for run in client.search_runs([found.experiment_id])}
    assert kinds == {"trial", "idea"}


def test_a_trial_that_cannot_be_sent_leaves_the_dashboard(runs, served, said, monkeypatch):
    """Nothing can be noted in the runs folder of somebody else."""
    ended_trial(runs, name="mine", enabled=False)

    def refuse(*_):
        raise PermissionError("not yours")

    monkeypatch.setattr(sync, "write_json", refuse)
    lines = said("ui").splitlines()
    assert lines[0].startswith("ideas")
    assert lines[2].startswith("left out: a_scene/")
    assert "not yours" in lines[2]
    assert len(served) == 1


def test_no_second_server_is_started(runs, served, said, monkeypatch):
    make_home(runs / "ab")
    assert "https://tracker.example" in said("ui --uri https://tracker.example")
    monkeypatch.setattr(servers, "_serves", lambda server, name, page: name == "ab")
    assert f"{LOCAL}/#/experiments/2/runs" in said("ui")
    assert served == []


@pytest.mark.parametrize(
    "words, message",
    [
        (["--uri", "file"], "--uri file is not an address"),
        (["none"], "no experiment 'none'"),
        (["ab"], "ab could not be sent to"),
    ],
)
def test_what_the_dashboard_cannot_show_is_refused(
    runs, served, refused, monkeypatch, words, message
):
    def full(*_):
        raise OSError("full")

    make_home(runs / "ab")
    monkeypatch.setattr(servers, "show_ideas", full)
    assert message in refused("ui", *words)
    assert served == []


def test_a_server_is_asked_whether_it_has_the_experiment(monkeypatch):
    page = f"{LOCAL}/#/experiments/12/runs"
    answers = [{"experiment": {"experiment_id": "12"}}, {"experiment": {}}, [], None]
    answers += [{"experiment": {"experiment_id": "1"}}]

    def get(place, params, timeout):
        assert place == f"{LOCAL}/api/2.0/mlflow/experiments/get-by-name"
        assert params == {"experiment_name": "x"}
        assert timeout == servers.SECONDS_TO_ANSWER
        return SimpleNamespace(json=lambda: answers.pop(0))

    monkeypatch.setattr(servers.requests, "get", get)
    assert [servers._serves(LOCAL, "x", page) for _ in range(4)] == [True, False, False, False]
    assert not servers._serves(LOCAL, "x", f"{LOCAL}/#/experiments/12")


# ---- gsbench view


def test_the_viewer_shows_one_or_two_trials_until_ctrl_c(runs, monkeypatch, capsys, refused):
    made = []

    class Viewer:
        url = "http://127.0.0.1:8080"

        def __init__(self, trials, port):
            made.append((trials, port))

        def stop(self):
            made.append("stopped")

    class Event:
        def wait(self):
            raise KeyboardInterrupt

    def check_port(port):
        made.append(port)

    monkeypatch.setattr(servers.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setitem(
        sys.modules, "gsbench.view.server", SimpleNamespace(Viewer=Viewer, check_port=check_port)
    )
    monkeypatch.setattr("gsbench.view.trials.find_trial", lambda address, runs: address)
    monkeypatch.setattr("gsbench.view.trials.load_viewed", lambda *given: given)
    proven = SimpleNamespace(rasterizer="rasterizer")
    monkeypatch.setattr("gsbench.train.proof.create_proven", lambda name, device: proven)
    monkeypatch.setattr(servers.threading, "Event", Event)
    assert servers.view(split("a b --device cpu --port 0"), runs) == 0
    cpu = torch.device("cpu")
    trials = [(name, "rasterizer", cpu) for name in "ab"]
    assert made == [0, (trials, 0), "stopped"]
    assert capsys.readouterr().out.splitlines() == [
        "http://127.0.0.1:8080  (Ctrl+C ends it)",
        "stopped",
    ]
    assert "one or two trials can be viewed, not 3" in refused("view a b c")
    monkeypatch.setattr(servers.importlib.util, "find_spec", lambda name: None)
    assert "the viewer needs the package viser: " in refused("view a")
