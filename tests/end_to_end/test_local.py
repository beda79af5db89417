"""Several trials at once on this machine: slots are kept, and a killed trial harms no other."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import pytest

from gsbench.system.resources import assign_gpu, available_threads, take_slot
from tests.end_to_end.conftest import SMALL
from tests.end_to_end.test_kills import results_of, start

pytestmark = pytest.mark.slow

SWEEP = ["-m", *SMALL, "name=local", "densify=adc", "launch=local", "launch.parallel=2", "tracking=none"]


def holders(runs: Path) -> dict[str, int]:
    found = {}
    for path in runs.glob("local/*/*/*/.lock.holder"):
        try:
            found[path.parent.name] = json.loads(path.read_text())["pid"]
        except (OSError, ValueError):
            continue
    return found


def test_one_killed_trial_harms_no_other_and_the_next_command_mends_it(
    environment: dict[str, str], tmp_path: Path
) -> None:
    pytest.importorskip("submitit", reason="needs the extra slurm")
    runs = tmp_path / "runs"
    process = start(environment, tmp_path, runs, *SWEEP, "seed=0,1,2")
    deadline = time.monotonic() + 120
    killed, most = "", 0
    while process.poll() is None and time.monotonic() < deadline:
        running = {trial: pid for trial, pid in holders(runs).items() if trial != killed}  # its file outlives it
        most = max(most, len(running))
        training = list(runs.glob("store/train/.*.partial/metrics.jsonl"))
        if not killed and training and running:
            killed, pid = next(iter(running.items()))
            os.kill(pid, signal.SIGKILL)
        time.sleep(0.05)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 1, output
    assert most == 2
    assert "2 of 3 trials done" in output
    assert "ended without a result" in output
    assert len(results_of(runs, "local")) == 2
    process = start(environment, tmp_path, runs, *SWEEP, "seed=0,1,2")
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert len(results_of(runs, "local")) == 3
    assert output.count("was done") == 2


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
