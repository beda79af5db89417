"""Slots for trials that run at once, and each trial's GPU and threads."""

import os
import socket
import subprocess
from shlex import split
from types import SimpleNamespace

import pytest
from filelock import FileLock

from gsbench.system.resources import (
    THREAD_VARIABLES,
    assign_gpu,
    assign_threads,
    available_threads,
    names_one_gpu,
    nvidia_smi,
    take_slot,
    trials_at_once,
)
from tests.helpers import table


def test_slots_gpus_and_threads(tmp_path, monkeypatch):
    with take_slot(tmp_path, 2) as first, take_slot(tmp_path, 2) as second:
        assert (first, second) == (0, 1)
    with take_slot(tmp_path, 2) as slot:
        assert slot == 0
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "as before")
    for slot, visible, expected in ((0, "3,5", "3"), (1, "3,5", "5"), (2, "3,5", "3")):
        assign_gpu(slot, visible)
        assert os.environ["CUDA_VISIBLE_DEVICES"] == expected
    os.environ["CUDA_VISIBLE_DEVICES"] = ""
    assign_gpu(0, "")
    assert os.environ["CUDA_VISIBLE_DEVICES"] == ""
    monkeypatch.delenv("SLURM_CPUS_PER_TASK", raising=False)
    assert available_threads(10**6) == 1
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "7")
    assert available_threads(2) == 7
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "0")
    assert available_threads(10**6) == 1
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "many")
    monkeypatch.setattr("gsbench.system.resources.available_cores", lambda: 7)
    assert [available_threads(), *map(available_threads, (1, 3, 8))] == [7, 7, 2, 1]
    for threads, expected in ((5, "5"), ("6", "6"), ("auto", "3")):
        assign_threads(threads, 2)
        assert {os.environ[name] for name in THREAD_VARIABLES} == {expected}


@pytest.fixture(autouse=True)
def _own_threads(monkeypatch):
    for name in THREAD_VARIABLES:
        monkeypatch.setenv(name, os.environ.get(name, "1"))


def test_a_taken_slot_is_waited_for(tmp_path, monkeypatch):
    pauses = []
    folder = tmp_path / ".slots" / socket.gethostname()
    folder.mkdir(parents=True)
    other = FileLock(folder / "0.lock")
    other.acquire()

    def sleep(seconds):
        pauses.append(seconds)
        if len(pauses) == 2:
            other.release()

    monkeypatch.setattr("time.sleep", sleep)
    with take_slot(tmp_path, 1) as slot:
        assert slot == 0
    assert pauses == [0.5, 0.5]
    with pytest.raises(KeyError), take_slot(tmp_path, 1):
        raise KeyError  # frees it, too
    with take_slot(tmp_path, 1):
        pass


def test_the_driver_tells_the_gpus_that_a_trial_may_get(monkeypatch):
    asked = []

    def smi(command, **how):
        asked.append(command)
        if error:
            raise error
        return SimpleNamespace(stdout="0\n1\n")

    error = None
    monkeypatch.setattr("subprocess.run", smi)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assign_gpu(3, None)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "1"
    assert asked == [split("nvidia-smi --query-gpu=index --format=csv,noheader")]
    assign_gpu(0, " 7 , ")
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "7"
    for error in (  # noqa: B007 - raised by the driver's program
        FileNotFoundError(),
        subprocess.CalledProcessError(9, "nvidia-smi"),
    ):
        assert nvidia_smi("name") == []
        assign_gpu(0, None)
        assert "CUDA_VISIBLE_DEVICES" not in os.environ
    assert [names_one_gpu(name) for name in ("cuda:0", "cuda", "cpu")] == [True, False, False]


@pytest.mark.parametrize(
    "cores, gigabytes, most, gpus, expected",
    table(__file__, "machines"),
)
def test_trials_at_once_suit_cores_memory_and_gpus(
    cores, gigabytes, most, gpus, expected, monkeypatch
):
    monkeypatch.setattr("gsbench.system.resources.available_cores", lambda: cores)
    monkeypatch.setattr("gsbench.system.resources.installed_gpus", lambda: ["0"] * gpus)
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(total=gigabytes * 10**9))
    assert trials_at_once.__wrapped__(most, "auto") == expected
    assert trials_at_once.__wrapped__(most, "cuda:1") == 1  # all trials are on that GPU
    if gpus == 3:
        assert trials_at_once.__wrapped__(most, "cpu") == 16
