"""`gsbench sync` beside a sweep: what it is told, what it sends, and what a bad tracker costs."""

import logging
import os
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from gsbench.system.locks import hold
from gsbench.tracking import Mirror, beside, connect
from gsbench.tracking.beside import permissions, send_beside
from gsbench.tracking.sync import MirrorError
from tests.helpers import read_json, write
from tests.processes import completed, wait_until
from tests.tracking.helpers import (
    STATE,
    begun_trial,
    child_environment,
    following,
    options,
    run_of,
    write_trial,
)
from tests.tracking.servers import Listener
from tests.trials import bare_trial


class Process:
    """Stands in for the process of ``gsbench sync``, which takes some seconds and may fail."""

    made: list["Process"]
    takes, code, said = 0.0, 0, b""

    def __init__(self, command, **how):
        self.command, self.how, self.killed = command, how, False
        file = Path(command[-1].removeprefix("--beside="))
        self.told, self.stdin, self.returncode = [read_json(file)], self, None
        self.made.append(self)
        how["stderr"].write(self.said)

    def poll(self):
        return self.returncode

    def wait(self, patience=0.0):
        if self.takes > patience and not self.killed:
            time.sleep(patience)
            raise subprocess.TimeoutExpired("sync", patience)
        self.returncode = self.code

    def close(self):
        self.told.append("the end")

    def kill(self):
        self.killed = True


@pytest.fixture
def processes(monkeypatch):
    monkeypatch.setattr(Process, "made", [], raising=False)
    monkeypatch.setattr(beside.subprocess, "Popen", Process)
    return Process.made


def tracked(runs, seed=0, uri=None, patience=30.0, **more):
    """A trial with a tracker."""
    return bare_trial(runs, seed, tracking=options(uri, patience) | more)


def warnings_in(caplog):
    return [one.getMessage() for one in caplog.records if one.levelno == logging.WARNING]


def test_one_process_is_told_which_trials_are_to_be_sent(processes, tmp_path):
    trials = [tracked(tmp_path, seed, patience=2.5) for seed in (0, 1)]
    write(trials[0].folder / "results.json", "of an earlier command")
    with Mirror([*trials, tracked(tmp_path, 2, enabled=False)]):
        ((told,),) = [process.told for process in processes]
        assert [*told["trials"]] == [str(one.folder) for one in trials]
        assert [[stamp > 0 for stamp in one] for one in told["trials"].values()] == [
            [False, True, False],
            [False] * 3,
        ]
        assert (told["pause"], told["patience"], told["allowed"]) == (0.2, 2.5, [])
    (process,) = processes
    assert process.told[1:] == ["the end"]
    assert process.how["env"]["GSBENCH_RUNS"] == str(tmp_path)
    assert process.command[1:-1] == ["-P", "-m", "gsbench", "sync"]
    assert not Path(process.command[-1].removeprefix("--beside=")).exists()


def test_a_process_that_crashed_is_replaced_at_the_end_and_told_all(processes, tmp_path, caplog):
    with Mirror([tracked(tmp_path)]):
        processes[0].returncode = -9
    assert len(processes) == 2
    assert processes[1].told == [*processes[0].told, "the end"]
    assert warnings_in(caplog) == []


@pytest.mark.parametrize("trials", [0, 1], ids=["none", "tracking=none"])
def test_nothing_is_started_where_nothing_is_to_be_sent(processes, tmp_path, trials):
    with Mirror([tracked(tmp_path, enabled=False)] * trials):
        pass
    assert processes == []


@pytest.mark.parametrize("error, least, most", [(None, 0.3, 2.0), (KeyboardInterrupt, 0.0, 0.25)])
def test_a_slow_tracker_gets_its_patience_and_less_if_the_sweep_is_stopped(
    processes, tmp_path, monkeypatch, caplog, error, least, most
):
    monkeypatch.setattr(Process, "takes", 60.0)
    monkeypatch.setattr(beside, "SECONDS_TO_STOP", 0.1)

    def sweep():
        with Mirror([tracked(tmp_path, patience=0.3)]):
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
    (line,) = warnings_in(caplog)
    assert line.startswith("tracking: the tracker is slow; the files are complete, `gsbench sync`")


@pytest.mark.parametrize(
    "code, said, words", [(1, b"more\ngsbench: down\n", "down"), (-9, b"", "it crashed (SIGKILL")]
)
def test_a_failure_is_reported_once_in_one_line(
    processes, tmp_path, monkeypatch, caplog, code, said, words
):
    monkeypatch.setattr(Process, "code", code)
    monkeypatch.setattr(Process, "said", said)
    with Mirror([tracked(tmp_path)]):
        pass
    (line,) = warnings_in(caplog)
    assert line.startswith("tracking: ")
    assert words in line


def test_a_process_that_cannot_start_harms_nothing(tmp_path, caplog, monkeypatch):
    def fail(*words, **how):
        raise OSError("no more processes")

    monkeypatch.setattr(beside.subprocess, "Popen", fail)
    with Mirror([tracked(tmp_path)]):
        pass
    assert "tracking: no more processes; the files are complete" in caplog.text


def test_the_process_gets_what_the_command_was_allowed_and_no_more(tmp_path):
    values = tracked(tmp_path).values
    assert permissions([values]) == []
    more = {"allow_targets": ["mine", "http://a:1"], "tracking": options("http://a:1")}
    given = values | more
    assert permissions([given, values, given]) == ["mine", "http://a:1"]


# ---- what the process sends


@pytest.fixture
def sent(monkeypatch):
    """The seeds of the trials of each send."""
    found = []

    def send(folders, uri, allowed):
        found.append([one.path.name[-1] for one in folders])
        return []

    monkeypatch.setattr(beside, "sync", send)
    monkeypatch.setattr(beside, "SECONDS_BETWEEN_LOOKS", 0.01)
    return found


def told(folders, pause=60.0, patience=1e6):
    trials = {str(folder): beside._stamps(folder) for folder in folders}
    content = {"trials": trials, "pause": pause, "patience": patience, "allowed": []}
    return write(folders[0].parents[4] / "told.json", content)


def test_a_trial_is_sent_from_its_beginning_to_its_end_and_at_once_when_it_ends(sent, tmp_path):
    trials = [tracked(tmp_path, seed) for seed in range(3)]

    def lines():
        for one, seed in zip(trials, "01", strict=False):
            with hold(one.folder / ".lock", "a trial"):
                write(one.folder / "config.yaml", one.values)
                write_trial(one.folder, one.values)
                wait_until(lambda seed=seed: [seed] in sent)
                time.sleep(0.1)  # as long as it works, it goes on
            wait_until(lambda seed=seed: sent.count([seed]) == 2)
        write(trials[2].folder / "config.yaml", trials[2].values)
        yield ""

    for one in trials:
        one.folder.mkdir(parents=True)
    send_beside(told([one.folder for one in trials]), lines())
    assert sent[:4] == [["0"], ["0"], ["1"], ["1"]]
    assert {*map(tuple, sent[4:])} == {("2",)}


def test_trials_are_sent_every_while_although_none_ends(sent, tmp_path):
    one = tracked(tmp_path)

    def lines():
        write(one.folder / "config.yaml", one.values)
        wait_until(lambda: sent.count(["0"]) > 2)
        yield ""

    send_beside(told([one.folder], pause=0.02), lines())


def test_a_trial_that_runs_again_is_sent_although_it_has_results_of_an_earlier_run(sent, tmp_path):
    folder, values = begun_trial(tmp_path)
    write_trial(folder, values)
    earlier = told([folder])

    def lines():
        time.sleep(0.1)
        assert sent == []
        os.utime(folder / "config.yaml")
        yield ""

    send_beside(earlier, lines())
    assert {*map(tuple, sent)} == {("0",)}


def test_a_trial_that_failed_and_is_run_again_by_another_sweep_is_sent_again(sent, tmp_path):
    folder, values = begun_trial(tmp_path)

    def lines():
        write(folder / "failed.json", "{}")
        wait_until(lambda: sent == [["0"]])
        time.sleep(0.1)
        assert sent == [["0"]]
        (folder / "failed.json").unlink()
        write_trial(folder, values)
        wait_until(lambda: len(sent) > 1)
        yield ""

    send_beside(told([folder]), lines())


def test_the_error_of_the_last_send_is_raised_and_those_before_are_not(monkeypatch, tmp_path):
    answers = []

    def refuse(*given):
        answers.append(given)
        raise MirrorError(f"no {len(answers)}")

    monkeypatch.setattr(beside, "sync", refuse)
    monkeypatch.setattr(beside, "SECONDS_BETWEEN_LOOKS", 0.01)

    def lines():
        wait_until(lambda: len(answers) >= 2)
        yield ""

    with pytest.raises(MirrorError) as error:
        send_beside(told([tracked(tmp_path).folder], pause=0.02), lines())
    assert str(error.value) == f"no {len(answers)}"


# ---- with MLflow


@pytest.mark.slow
def test_a_trial_is_shown_from_its_beginning_to_its_end(runs):
    folder, values = begun_trial(runs, seed=4)
    with following(options(), folder):
        (folder / "metrics.jsonl").write_text('{"step": 1, "loss": 0.5}\n')
        wait_until((folder / STATE).exists)
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
    (line,) = warnings_in(caplog)
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


def test_a_trial_whose_lock_another_holds_is_left_alone(tmp_path):
    folder, values = begun_trial(tmp_path)
    file = told([folder])
    write_trial(folder, values)
    words = [sys.executable, "-P", "-m", "gsbench", "sync", f"--beside={file}"]
    environment = child_environment() | {"GSBENCH_RUNS": str(tmp_path)}
    with hold(folder / ".mlflow.lock", "mirroring"):
        completed(words, env=environment, input="", timeout=300)
    assert not (folder / STATE).exists()
    assert not file.exists()


@pytest.mark.slow
def test_a_process_whose_sweep_was_killed_ends_soon_though_its_tracker_hangs(tmp_path):
    folder, _ = begun_trial(tmp_path)
    code = "import pathlib, sys, time; from gsbench.tracking import beside; "
    code += "beside.sync = lambda *given: time.sleep(600); "
    code += "beside.send_beside(pathlib.Path(sys.argv[1]), sys.stdin)"
    words = [sys.executable, "-c", code, str(told([folder], pause=0.1, patience=0.5))]
    with subprocess.Popen(words, env=child_environment(), stdin=subprocess.PIPE) as child:
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(10)
        child.stdin.close()
        assert child.wait(120) == 1
