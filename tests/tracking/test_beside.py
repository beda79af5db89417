"""`gsbench sync` beside a sweep: what it is asked for, and what a bad tracker costs."""

import logging
import subprocess
import sys
import time

import psutil
import pytest

from gsbench.system.locks import hold
from gsbench.tracking import Mirror, beside, connect
from gsbench.tracking.beside import permissions
from tests.tracking.helpers import (
    STATE,
    begun_trial,
    child_environment,
    following,
    found_runs,
    options,
    run_of,
    write_trial,
)
from tests.tracking.servers import Listener


class Process:
    """Stands in for the process of ``gsbench sync``, which takes some seconds and may fail."""

    made: list["Process"]
    takes, code, said = 0.0, 0, ""

    def __init__(self, command, **how):
        self.command, self.how, self.killed = command, how, False
        self.made.append(self)
        self.returncode = None

    def communicate(self):
        end = time.monotonic() + self.takes
        while time.monotonic() < end and not self.killed:
            time.sleep(0.01)
        self.returncode = self.code
        return "", self.said

    def kill(self):
        self.killed = True

    def trials(self):
        return [self.command[k + 1] for k, one in enumerate(self.command) if one == "--trial"]


@pytest.fixture
def processes(monkeypatch):
    monkeypatch.setattr(Process, "made", [], raising=False)
    monkeypatch.setattr(beside.subprocess, "Popen", Process)
    return Process.made


def configured(values, uri=None, patience=30.0, **more):
    return values | {"tracking": options(uri, patience) | more}


def test_each_trial_is_sent_until_it_has_ended(processes, tmp_path):
    with Mirror() as mirror:
        for seed in (0, 1):
            folder, values = begun_trial(tmp_path, seed)
            mirror.follow(folder, configured(values, flush_seconds=60.0))
            if seed == 0:
                write_trial(folder, values)
            mirror.trial_ended()
            while len(processes) <= seed or processes[-1].returncode is None:
                time.sleep(0.01)
    sent = [[name[-1] for name in process.trials()] for process in processes]
    assert sent == [["0"], ["1"], ["1"]]
    assert processes[0].how["env"]["GSBENCH_RUNS"] == str(tmp_path)
    assert processes[0].command[1:6] == ["-P", "-m", "gsbench", "sync", "tracked"]


def test_a_process_runs_every_while_although_no_trial_ends(processes, tmp_path):
    folder, values = begun_trial(tmp_path)
    with Mirror() as mirror:
        mirror.follow(folder, configured(values, flush_seconds=0.05))
        while len(processes) < 3:
            time.sleep(0.01)


@pytest.mark.parametrize(
    "settings, idle", [({"enabled": False}, False), ({}, True)], ids=["tracking=none", "idle"]
)
def test_nothing_is_started_where_nothing_is_to_be_sent(processes, tmp_path, settings, idle):
    folder, values = begun_trial(tmp_path)
    with Mirror(idle) as mirror:
        mirror.follow(folder, configured(values, **settings))
    assert processes == []


@pytest.mark.parametrize("error, least, most", [(None, 0.3, 2.0), (KeyboardInterrupt, 0.0, 0.25)])
def test_a_slow_tracker_gets_its_patience_and_less_if_the_sweep_is_stopped(
    processes, tmp_path, monkeypatch, caplog, error, least, most
):
    monkeypatch.setattr(Process, "takes", 60.0)
    monkeypatch.setattr(beside, "SECONDS_TO_STOP", 0.1)
    folder, values = begun_trial(tmp_path)

    def sweep():
        with Mirror() as mirror:
            mirror.follow(folder, configured(values, patience=0.3))
            if error is not None:
                raise error

    started = time.monotonic()
    if error is None:
        sweep()
    else:
        with pytest.raises(error):
            sweep()
    assert least <= time.monotonic() - started < most
    assert all(process.killed for process in processes)
    (line,) = [one.getMessage() for one in caplog.records if one.levelno == logging.WARNING]
    assert line.startswith("tracking: the tracker is slow; the files are complete, `gsbench sync`")


@pytest.mark.parametrize(
    "code, said, words", [(1, "more\ngsbench: down\n", "down"), (-9, "", "it crashed (SIGKILL")]
)
def test_a_failure_is_reported_once_in_one_line(
    processes, tmp_path, monkeypatch, caplog, code, said, words
):
    monkeypatch.setattr(Process, "code", code)
    monkeypatch.setattr(Process, "said", said)
    folder, values = begun_trial(tmp_path)
    with Mirror() as mirror:
        mirror.follow(folder, configured(values, flush_seconds=0.02))
        time.sleep(0.2)
    assert len(processes) > 1
    (line,) = [one.getMessage() for one in caplog.records if one.levelno == logging.WARNING]
    assert line.startswith("tracking: ")
    assert words in line


def test_a_process_that_cannot_start_harms_nothing(tmp_path, caplog, monkeypatch):
    def fail(*words, **how):
        raise OSError("no more processes")

    monkeypatch.setattr(beside.subprocess, "Popen", fail)
    folder, values = begun_trial(tmp_path)
    with Mirror() as mirror:
        mirror.follow(folder, configured(values))
    assert "tracking: no more processes; the files are complete" in caplog.text


def test_the_process_gets_what_the_command_was_allowed_and_no_more(tmp_path):
    _, values = begun_trial(tmp_path)
    assert permissions(configured(values)) == []
    given = configured(values, "http://a:1") | {"allow_targets": ["mine", "http://a:1"]}
    assert permissions(given) == ["mine", "http://a:1"]


# ---- with MLflow


@pytest.mark.slow
def test_a_trial_is_shown_from_its_beginning_to_its_end(runs):
    folder, values = begun_trial(runs, seed=4)
    with following(options(), folder):
        (folder / "metrics.jsonl").write_text('{"step": 1, "loss": 0.5}\n')
        deadline = time.monotonic() + 240
        while not (folder / STATE).exists():
            assert time.monotonic() < deadline
            time.sleep(0.1)
        write_trial(folder, values)
    assert run_of(connect(None, runs), 4).info.status == "FINISHED"


@pytest.mark.slow
@pytest.mark.parametrize("uri", ["not a database", "nonsense"])
def test_a_broken_tracker_harms_no_trial(uri, tmp_path, caplog):
    (tmp_path / "broken.db").write_text("this is no database" * 100)
    address = {
        "not a database": f"sqlite:///{tmp_path}/broken.db",
        "nonsense": "gopher://x",
    }[uri]
    folder, values = begun_trial(tmp_path, uri=address)
    with following(options(address), folder):
        write_trial(folder, values)
    (line,) = [one.getMessage() for one in caplog.records if one.levelno == logging.WARNING]
    assert line.startswith("tracking: ")
    assert "gsbench sync" in line
    assert "\n" not in line
    assert (folder / "results.json").exists()


def test_no_process_is_left_by_a_tracker_that_never_answers(tmp_path, caplog):
    others = set(psutil.Process().children())
    with Listener() as tracker:
        slow = options(f"http://127.0.0.1:{tracker.port}", patience=0.2)
        folder, values = begun_trial(tmp_path, uri=slow["uri"], patience=0.2)
        with following(slow, folder):
            write_trial(folder, values)
    assert "tracking: the tracker is slow" in caplog.text
    _, alive = psutil.wait_procs(set(psutil.Process().children()) - others, timeout=60)
    assert not alive


@pytest.mark.slow
def test_a_process_whose_sweep_was_killed_ends_soon(tmp_path):
    """Its tracker may hang for ever."""
    code = "import time; from gsbench.tracking import beside; beside.SECONDS_AFTER_PARENT = 0.5; "
    code += "beside.end_with(int(__import__('sys').argv[1])); time.sleep(600)"
    parent = subprocess.Popen(["sleep", "600"])
    child = subprocess.Popen([sys.executable, "-c", code, str(parent.pid)], env=child_environment())
    with pytest.raises(subprocess.TimeoutExpired):
        child.wait(10)
    parent.kill()
    parent.wait()
    assert child.wait(120) == 1


@pytest.mark.slow
def test_a_trial_whose_lock_another_holds_is_left_alone(runs):
    folder, values = begun_trial(runs, seed=6)
    write_trial(folder, values)
    with hold(folder / ".mlflow.lock", "mirroring"), Mirror() as mirror:
        mirror.follow(folder, configured(values))
    assert not [
        run
        for run in found_runs(connect(None, runs), "tracked")
        if run.data.tags.get("seed") == "6"
    ]
