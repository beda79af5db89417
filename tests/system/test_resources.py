"""Slots for trials that run at once, and each trial's GPU and threads."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from gsbench.system.resources import assign_gpu, available_threads, take_slot, trials_at_once


def test_slots_gpus_and_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


@pytest.mark.parametrize(
    ("cores", "gigabytes", "most", "gpus", "expected"),
    [
        (2, 16, None, 0, 2),
        (1, 16, None, 0, 1),
        (6, 16, None, 0, 2),
        (64, 256, 100_000, 0, 16),
        (64, 16, 3_000_000, 0, 2),
        (64, 256, None, 1, 1),
    ],
)
def test_trials_at_once_suit_cores_memory_and_gpus(
    cores: int,
    gigabytes: int,
    most: int | None,
    gpus: int,
    expected: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gsbench.system.resources.available_cores", lambda: cores)
    monkeypatch.setattr("gsbench.system.resources.installed_gpus", lambda: ["0"] * gpus)
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(total=gigabytes * 10**9))
    assert trials_at_once.__wrapped__(most, "auto") == expected
    assert trials_at_once.__wrapped__(most, "cuda:1") == 1  # all trials are on that GPU
