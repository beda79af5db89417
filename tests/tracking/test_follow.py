"""The mirror and its process, with stand-ins for the process and for the tracker."""

import io
import json
import logging
import os
import signal
import subprocess
import sys
import time
from queue import Queue
from shlex import split
from types import SimpleNamespace
from typing import Any

import pytest

from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import BusyError, hold
from gsbench.tracking import Mirror, mirror, tracker_run
from gsbench.tracking.tracker_run import MirrorError, mirror_ended, refusal, sync
from tests.tracking.helpers import begin_trial, begun_trial, options, write_trial
from tests.trials import trial_values

# ---- the sweep's side


class Process:
    """Stands in for the mirror's process, which ends with ``code`` after ``takes`` seconds."""

    code, takes, errors = 0, 0.0, b""

    def __init__(self, made, command, stderr, **how):
        made.append(self)
        self.command, self.stderr, self.how = command, stderr, how
        self.stdin, self.did = io.BytesIO(), list[Any]()
        self.returncode = None

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.did.append("closed")

    def poll(self):
        return self.returncode

    def communicate(self, timeout):
        self.did.append(timeout)
        if self.takes > timeout:
            raise subprocess.TimeoutExpired("mirror", timeout)
        self.stderr.write(self.errors)
        self.returncode = self.code

    def kill(self):
        self.did.append("killed")


@pytest.fixture
def processes(monkeypatch, caplog):
    made = []
    monkeypatch.setattr(subprocess, "Popen", lambda command, **how: Process(made, command, **how))
    return made


def test_one_process_gets_the_folders_of_all_trials(processes, tmp_path, caplog):
    settings = options(patience=7.0)
    with Mirror() as one:
        one.follow(tmp_path / "off", settings | {"enabled": False})
        assert processes == []
        one.follow(tmp_path / "a", settings)
        one.follow(tmp_path / "b", settings)
        (process,) = processes
        told = [json.loads(line) for line in process.stdin.getvalue().splitlines()]
        assert told == [[f"{tmp_path}/{name}", settings] for name in ("a", "b")]
    assert process.command[-2:] == ["0.2", "7.0"]
    assert process.how["start_new_session"]  # Ctrl-C does not reach it
    assert process.did == [7.0, "killed", "closed"]
    with Mirror(idle=True) as idle:
        idle.follow(tmp_path / "a", settings)
    assert len(processes) == 1
    assert caplog.messages == []


@pytest.mark.parametrize(
    "error, seconds", [(None, 7.0), (ValueError(), 7.0), (KeyboardInterrupt(), 3.0)]
)
def test_a_stopped_sweep_waits_less_for_a_slow_tracker(
    processes, tmp_path, caplog, monkeypatch, error, seconds
):
    monkeypatch.setattr(Process, "takes", 7.5)

    def sweep():
        with Mirror() as one:
            one.follow(tmp_path, options(patience=7.0) | {"_target_": "gsbench.tracking.WandB"})
            if error is not None:
                raise error

    if error is None:
        sweep()
    else:
        with pytest.raises(type(error)):
            sweep()
    assert processes[0].did == [seconds, "killed", "closed"]
    assert processes[0].stderr.closed
    assert caplog.messages == ["tracking: WandB is slow; `gsbench sync` mirrors the rest later"]


REST = "; the files are complete, `gsbench sync` mirrors them later"


@pytest.mark.parametrize(
    "code, errors, said",
    [
        (3, b"Traceback\n  File\nMLflow does not take x\n", "MLflow does not take x"),
        (
            -9,
            b"ValueError: 5\nmore\n",
            "the mirror crashed (SIGKILL, perhaps out of memory); its last lines: ValueError: 5;",
        ),
        (1, b"", "the mirror ended early (exit code 1); its last lines: (no output)"),
    ],
)
def test_a_failed_mirror_is_reported_once_and_the_next_trial_gets_another(
    processes, tmp_path, caplog, monkeypatch, code, errors, said
):
    monkeypatch.setattr(Process, "code", code)
    monkeypatch.setattr(Process, "errors", errors)
    caplog.set_level(logging.WARNING)
    with Mirror() as one:
        one.follow(tmp_path, options())
        processes[0].returncode = code  # it has ended meanwhile
        one.follow(tmp_path, options())
        assert processes[0].did[0] == 0
        assert len(processes) == 2
        assert len(caplog.messages) == 1
    assert len(caplog.messages) == 2
    for message in caplog.messages:
        assert message.startswith(f"tracking: {said}")
        assert message.endswith(REST)


def test_a_mirror_that_cannot_start_harms_nothing(tmp_path, caplog, monkeypatch):
    def fail(*words, **how):
        raise OSError("no memory")

    monkeypatch.setattr(subprocess, "Popen", fail)
    with Mirror() as one:
        one.follow(tmp_path, options())
    assert caplog.messages == [f"tracking: no memory{REST}"]


# ---- a trial and its tracker


class Tracker:
    """A tracker that keeps what it is told."""

    told: list[Any]
    refuses: BaseException | None = None

    def open(self, trial, run):
        self.told.append(("open", run.complete))
        return f"run {run.token}"

    def params(self, values):
        pass

    def tags(self, values):
        if "note" in values:
            self.told.append(("note", values["note"]))

    def metrics(self, scalars):
        if self.refuses:
            raise self.refuses
        self.told.append(("log", {one.key.split("/")[1] for one in scalars}, len(scalars)))

    def artifacts(self, files, pictures):
        self.told.append(("files", list(files)))

    def close(self, status, reason):
        self.told.append((status, reason))


@pytest.fixture
def told(monkeypatch):
    monkeypatch.setattr(Tracker, "told", [], raising=False)
    monkeypatch.setattr(tracker_run, "make_sink", lambda settings, allowed: Tracker())
    monkeypatch.setattr(tracker_run, "publish", lambda home, uri: None)
    return Tracker.told


def words(told):
    return [word for word, *_ in told]


ENDED = split("log note files FINISHED")


def test_a_tracker_that_fails_frees_the_trial(told, tmp_path, monkeypatch):
    values = trial_values(tmp_path)
    write_trial(TrialFolder.of(values).path, values)
    monkeypatch.setattr(Tracker, "refuses", ValueError("no\nmore"))
    for _ in range(2):
        with pytest.raises(ValueError, match="no"):
            mirror_ended(TrialFolder.of(values), options(), values)
    error = refusal(TrialFolder.of(values), options(), ValueError("x" * 201 + "\nmore"))
    label = TrialFolder.of(values).label
    assert str(error) == f"{label} could not be sent to MLflow (ValueError: {'x' * 200})"
    assert str(refusal(TrialFolder.of(values), options(), KeyError())).endswith("(KeyError: )")


def test_sync_mirrors_ended_trials_and_counts_them(told, tmp_path, monkeypatch):
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    done, damaged, failed, partial, strange, busy = (
        begin_trial(trial_values(tmp_path, seed), "http://strange" if seed == 4 else None)
        for seed in range(6)
    )
    for folder, seed in ((done, 0), (strange, 4), (busy, 5)):
        write_trial(folder, trial_values(tmp_path, seed))
    (damaged / "results.json").write_text("{")
    (failed / "failed.json").write_text("{}")
    folders = [TrialFolder(one) for one in (done, damaged, failed, partial, strange, busy)]
    label = {one.path: one.label for one in folders}
    with hold(busy / tracker_run.LOCK, "mirroring"):
        lines = list(sync(folders, None))
    assert lines == [
        f"mirrored {label[done]}",
        f"left out: {label[damaged]}: damaged, see gsbench status",
        f"mirrored {label[failed]}",
        f"left out: {label[strange]}: its configuration names the tracker http://strange, and "
        "--uri http://strange was not typed",
        f"{label[busy]} is being mirrored by another process",
        "2 trials mirrored now, 0 before",
    ]
    assert list(sync(folders[:1], None)) == ["0 trials mirrored now, 1 before"]
    assert list(sync([folders[4]], "http://strange"))[-1] == "1 trial mirrored now, 0 before"
    (busy / "events.jsonl").unlink()
    for error in (ValueError("no"), SystemExit("no")):  # code of a user's may end the process
        monkeypatch.setattr(Tracker, "refuses", error)
        line = rf"could not be sent to MLflow \({type(error).__name__}: no\)"
        with pytest.raises(MirrorError, match=line):
            list(sync(folders[5:], None))


def test_the_page_of_an_experiment_is_renewed_in_mlflow_alone(tmp_path, monkeypatch):
    published = []
    monkeypatch.setattr(tracker_run, "publish", lambda home, uri: published.append((home, uri)))
    folder = TrialFolder.of(trial_values(tmp_path))
    pages = {
        (folder.home, "u"): (folder, options("u")),
        (folder.home, "w"): (folder, options("w") | {"_target_": "gsbench.tracking.WandB"}),
    }
    tracker_run.renew_pages(pages)
    assert published == [(folder.home, "u")]
    assert pages == {}

    def refuse(home, uri):
        raise KeyError("no page")

    monkeypatch.setattr(tracker_run, "publish", refuse)
    with pytest.raises(MirrorError, match=r"could not be sent to MLflow .*KeyError: 'no page'"):
        tracker_run.renew_pages({(folder.home, None): (folder, options())})


# ---- the process's side


class Followed:
    """Stands in for a trial that ends at its second reading, or raises ``error``."""

    made: list["Followed"]
    error: BaseException | None = None

    def __init__(self, folder, options):
        self.folder, self.options, self.has_ended = folder, options, False
        self.calls = []
        self.made.append(self)

    def catch_up(self, last):
        self.calls.append(last)
        if self.error:
            raise self.error
        self.has_ended = len(self.calls) == 2


@pytest.fixture
def followed(monkeypatch):
    monkeypatch.setattr(Followed, "made", [], raising=False)
    monkeypatch.setattr(mirror, "_FollowedTrial", Followed)
    return Followed.made


class Lines:
    """The lines of stdin: between two lists of lines nothing comes for a while."""

    def __init__(self, *parts):
        self.parts, self.queue, self.pauses = list(parts), Queue[str | None](), list[float]()

    def get(self, timeout):
        self.pauses.append(timeout)
        for line in self.parts.pop(0):
            self.queue.put(line)
        return self.queue.get_nowait()

    def get_nowait(self):
        return self.queue.get_nowait()


def line(folder):
    return json.dumps([folder, options("u")])


def test_trials_are_read_until_the_end_of_the_input(followed, monkeypatch):
    renewed = []
    now = iter([100.0, 100.0, 159.0, 160.5, 160.5, 170.0, 170.0])
    monkeypatch.setattr(
        mirror, "renew_pages", lambda pages: renewed.append(sorted(map(str, pages)))
    )
    monkeypatch.setattr(time, "monotonic", lambda: next(now))
    lines = Lines([line("a/b/c/d"), line("a/b/c/e")], [], [line("a/b/c/f")], [None])
    mirror._follow(lines, 0.5)
    assert [str(one.folder.path) for one in followed] == ["a/b/c/d", "a/b/c/e", "a/b/c/f"]
    # the first two ended at the second reading; the last one is read once more at the end
    assert [one.calls for one in followed] == [[False, False], [False, False], [False, True]]
    assert lines.pauses == [0.5] * 4
    # at once, then after more than a minute, and at the end
    page = str((followed[0].folder.home, "u"))
    assert renewed == [[], [page], [page]]


@pytest.mark.parametrize("error", [ValueError("down"), SystemExit("down"), BusyError("other")])
def test_an_error_is_only_raised_at_the_end(followed, monkeypatch, error):
    monkeypatch.setattr(Followed, "error", error)
    monkeypatch.setattr(mirror, "renew_pages", lambda pages: None)
    lines = Lines([line("a/b/c/d")], [], [None])
    if isinstance(error, BusyError):
        mirror._follow(lines, 0)
    else:
        with pytest.raises(MirrorError, match=r"could not be sent to MLflow \(\w+: down\)"):
            mirror._follow(lines, 0)
    assert followed[0].calls == [False, False, True]


def test_a_trial_is_opened_once_it_runs_or_has_ended_now(told, tmp_path):
    values = trial_values(tmp_path)
    folder = TrialFolder.of(values).path
    one = mirror._FollowedTrial(TrialFolder(folder), options())
    one.catch_up(last=True)  # it has no configuration yet
    begin_trial(values)
    write_trial(folder, values)
    os.utime(folder / "results.json", (1, 1))  # of an earlier run
    one.catch_up(last=False)
    assert told == []
    with hold(folder / ".lock", "a trial"):
        one.catch_up(last=False)
        assert words(told) == ["open"]
        one.catch_up(last=False)
        assert not one.has_ended
    one.catch_up(last=False)
    assert words(told[1:]) == ["log", "log", *ENDED]
    assert one.has_ended
    assert mirror_ended(TrialFolder(folder), options(), values) is False  # it was let go


def test_a_trial_that_never_began_is_not_sent_where_its_old_configuration_says(told, tmp_path):
    values = trial_values(tmp_path)
    folder = TrialFolder(begin_trial(values, "http://theirs"))
    one = mirror._FollowedTrial(folder, options("http://own"))
    one.catch_up(last=True)
    assert one._run._options["uri"] == "http://own"


@pytest.mark.parametrize("name", ["results.json", "failed.json", "none"])
def test_a_trial_that_ended_before_it_was_seen_is_mirrored(told, tmp_path, name):
    folder, values = begun_trial(tmp_path)
    one = mirror._FollowedTrial(TrialFolder(folder), options())
    one._added_at = 100.0
    if name == "failed.json":
        (folder / name).write_text("{}")
    elif name == "results.json":
        write_trial(folder, values)
    for moment in (99, 100):
        if name != "none":
            os.utime(folder / name, (moment, moment))
        one.catch_up(last=False)
        assert one.has_ended == (moment == 100 and name != "none")
    if name == "none":
        one.catch_up(last=True)
        assert (one.has_ended, told[-1]) == (True, ("KILLED", None))


@pytest.mark.parametrize("error", [None, ValueError("tracker\n down")])
def test_the_process_ends_at_once_with_the_reason_in_its_last_line(monkeypatch, capsys, error):
    ended = []
    given = []

    def follow(lines, pause):
        given.append(pause)
        if error:
            raise error

    monkeypatch.setattr(sys, "argv", split("-c follow 0.5 30"))
    monkeypatch.setattr(mirror, "_follow", follow)
    monkeypatch.setattr(mirror, "_read_input", lambda lines, patience: given.append(patience))
    monkeypatch.setattr(os, "_exit", ended.append)
    signals = []
    monkeypatch.setattr(signal, "signal", lambda *what: signals.append(what))
    mirror.follow()
    assert sorted(given) == [0.5, 30.0]
    assert ended == [0 if error is None else mirror.TRACKER_FAILED]
    assert signals == [(signal.SIGTERM, signal.SIG_DFL)]
    shown = capsys.readouterr().err.splitlines()
    assert shown[-1:] == ([] if error is None else ["tracker down"])


def test_a_process_whose_parent_is_gone_ends_after_some_patience(monkeypatch):
    did = []
    monkeypatch.setattr(sys, "stdin", io.StringIO("a\nb\n"))
    monkeypatch.setattr(time, "sleep", did.append)
    monkeypatch.setattr(os, "_exit", lambda code: did.append(f"exit {code}"))
    lines = SimpleNamespace(put=did.append)
    mirror._read_input(lines, 30.0)
    assert did == ["a", "b", None, 40.0, "exit 1"]
