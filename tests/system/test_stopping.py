"""Signals stop the program at once or at the end of a step; locks are held by one process."""

import os
import signal
import sys
import threading

import pytest
from filelock import FileLock, Timeout

from gsbench.system import locks, programs
from gsbench.system.locks import BusyError, LockHolder, describe_holder, hold, is_held, read_holder
from gsbench.system.programs import AllowedModules, adopt_modules, allow_modules
from gsbench.system.stopping import (
    SIGNALS,
    SIGNALS_WITHOUT_INTERRUPT,
    Stopped,
    deferred,
    interrupts_ignored,
    reinstall_handlers,
    requested,
    stop_on_signals,
)
from tests.helpers import read_json


def test_each_signal_stops_the_block_and_the_earlier_handlers_come_back():
    before = [signal.getsignal(number) for number in SIGNALS]
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2):
        with pytest.raises(Stopped) as stop, stop_on_signals():
            signal.raise_signal(number)
        assert (str(stop.value), stop.value.exit_code) == (number.name, 128 + number)
        assert [signal.getsignal(number) for number in SIGNALS] == before
    with stop_on_signals(SIGNALS_WITHOUT_INTERRUPT):
        assert signal.getsignal(signal.SIGINT) is before[0]
        assert signal.getsignal(signal.SIGTERM) is not before[1]
        # pycolmap replaces the handler
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        with stop_on_signals([signal.SIGINT]):
            reinstall_handlers()
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
        reinstall_handlers()
        assert callable(signal.getsignal(signal.SIGTERM))
    reinstall_handlers()
    assert [signal.getsignal(number) for number in SIGNALS] == before


def test_a_deferred_signal_stops_at_the_end_of_the_block_and_a_second_one_at_once():
    with stop_on_signals():
        with pytest.raises(Stopped, match="SIGTERM"), deferred():  # noqa: PT012
            with deferred():
                assert not requested()
            signal.raise_signal(signal.SIGTERM)
            assert requested()
        with pytest.raises(Stopped, match="SIGINT"), deferred():  # noqa: PT012 - it was asked for
            signal.raise_signal(signal.SIGINT)
            raise AssertionError("the second signal has no effect")
    assert not requested()
    with stop_on_signals():
        signal.signal(signal.SIGUSR2, signal.SIG_IGN)  # as an import may do
        with deferred():
            pass
        with pytest.raises(Stopped, match="SIGUSR2"):
            signal.raise_signal(signal.SIGUSR2)


def test_ctrl_c_is_ignored_within_a_block_and_other_threads_have_no_handlers():
    before = signal.getsignal(signal.SIGINT)
    with interrupts_ignored():
        signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    assert signal.getsignal(signal.SIGINT) is before
    ran = []

    def work():
        with stop_on_signals(), interrupts_ignored(), deferred():
            ran.append(signal.getsignal(signal.SIGINT) is before)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert ran == [True]


# ---- locks


def test_a_lock_names_its_holder_as_long_as_it_is_held(tmp_path, monkeypatch):
    lock = tmp_path / "a.lock"
    monkeypatch.setenv("SLURM_JOB_ID", "5")
    monkeypatch.setattr("time.time", lambda: 12.5)
    assert describe_holder(lock) == "another process"
    with hold(lock, "the work"):
        holder = read_holder(lock)
        assert (holder.pid, holder.since, holder.what) == (os.getpid(), 12.5, "the work")
        assert describe_holder(lock) == f"process {os.getpid()} on {holder.host}, Slurm job 5"
    assert read_holder(lock) is None
    assert LockHolder(host="b", pid=1, since=0).description == "process 1 on b"
    (tmp_path / "target").write_text("kept")
    (tmp_path / "a.lock.holder").symlink_to(tmp_path / "target")
    with hold(lock, "the work"):
        assert read_json(tmp_path / "a.lock.holder")["what"] == "the work"
    assert (tmp_path / "target").read_text() == "kept"
    with pytest.raises(KeyError), hold(lock, "the work"):
        raise KeyError
    assert not is_held(lock)


def test_a_held_lock_is_waited_for_with_a_word_or_is_an_error(tmp_path, monkeypatch, logged):
    asked = []

    class Held:
        def __init__(self, path):
            pass

        def acquire(self, **how):
            asked.append(how)
            if how == {"timeout": 0}:
                raise Timeout("x")

        def release(self):
            asked.append("released")

    monkeypatch.setattr(locks, "FileLock", Held)
    with pytest.raises(BusyError, match=r"^the work: another process works on it$"):
        hold(tmp_path / "a", "the work", wait=False).__enter__()
    with hold(tmp_path / "a", "the work"):
        pass
    assert asked == [{"timeout": 0}, {"timeout": 0}, {"poll_interval": 0.25}, "released"]
    assert logged.messages == ["waiting for the work: another process works on it"]


@pytest.mark.parametrize("system", ["with flock", "without"])
def test_whether_a_lock_is_held_is_seen_on_every_system(tmp_path, monkeypatch, system):
    if system == "without":
        monkeypatch.setattr(locks, "fcntl", None)
    lock = tmp_path / "a"
    assert not is_held(lock)
    other = FileLock(lock)
    with other:
        assert is_held(lock)
    assert not is_held(lock)
    with other:  # looking has not taken it
        pass


# ---- a user's modules


def test_only_allowed_modules_are_found_in_their_folder(tmp_path, monkeypatch):
    finder = AllowedModules()
    monkeypatch.setattr(programs, "_allowed", finder)
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
    monkeypatch.chdir(tmp_path)
    for name in ("mine", "other"):
        (tmp_path / f"{name}.py").touch()
    allow_modules(["mine.sub.Class", "mine.Other"])
    allow_modules(["theirs"], "/there")
    adopt_modules({"theirs": "/elsewhere"})
    assert finder.folders == {"mine": str(tmp_path), "theirs": "/elsewhere"}
    assert sys.meta_path.count(finder) == 1
    assert sys.meta_path[-1] is finder  # installed modules come first
    found = finder.find_spec("mine")
    assert found.origin == str(tmp_path / "mine.py")
    assert finder.find_spec("other") is None
    assert finder.find_spec("mine", ["/package"]) is None
    assert finder.find_spec("theirs") is None
