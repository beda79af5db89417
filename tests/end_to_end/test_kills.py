"""The program under attack: kills, rivals, a full disk, a read-only folder, damaged files, signals."""

from __future__ import annotations

import hashlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.end_to_end.conftest import SMALL, Run
from tests.processes import bytes_written

pytestmark = pytest.mark.slow

SWEEP = ["-m", *SMALL, "name=attacked", "densify=adc,volumetric", "tracking=none", "train.checkpoint_every=40"]
TRIALS = 2
CLOCKED = ("seconds", "peak_memory_mb", "measured")  # what differs between two runs of the same trial


def start(environment: dict[str, str], cwd: Path, runs: Path, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "gsbench.cli", *arguments],
        cwd=cwd,
        env=environment | {"GSBENCH_RUNS": str(runs)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def results_of(runs: Path, name: str = "attacked") -> dict[str, Any]:
    """Everything that a sweep found out: results without times, and checksums of models, pictures and tables."""
    found: dict[str, Any] = {}
    for path in sorted(runs.glob(f"{name}/*/*/*/results.json")):
        results = {key: value for key, value in json.loads(path.read_text()).items() if key not in CLOCKED}
        results["init_report"].pop("seconds", None)
        results.pop("experiment")
        files = [path.parent / "point_cloud.ply", path.parent / "per_view.csv", path.parent / "events.jsonl"]
        files += sorted(path.parent.glob("renders/*.png"))
        results["files"] = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}
        found[f"{path.parent.parent.name}/{path.parent.name}"] = results
    return found


@pytest.fixture(scope="module")
def undisturbed(environment: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("undisturbed")
    process = start(environment, folder, folder / "runs", *SWEEP)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    results = results_of(folder / "runs")
    assert len(results) == TRIALS
    return results


def wait_for(runs: Path, pattern: str, process: subprocess.Popen[str], seconds: float = 120) -> None:
    deadline = time.monotonic() + seconds
    while not list(runs.glob(pattern)) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    assert list(runs.glob(pattern)), f"{pattern} did not appear"


def training_log_size(runs: Path) -> int:
    return bytes_written(runs, "store/train/.*.partial/metrics.jsonl")


def test_killed_stopped_and_damaged_the_sweep_ends_as_undisturbed(
    environment: dict[str, str], undisturbed: dict[str, Any], tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    rng = random.Random(4)
    moments = ["store/*/.*.partial", "store/train/.*.partial/checkpoint-*.pt", "attacked/*/*/*/results.json"]
    for moment in moments:
        process = start(environment, tmp_path, runs, *SWEEP)
        wait_for(runs, moment, process)
        time.sleep(rng.uniform(0, 0.8))
        process.send_signal(signal.SIGKILL)
        process.communicate()
    if len(results_of(runs)) < TRIALS:  # the last kill may have come after the end
        written = training_log_size(runs)
        process = start(environment, tmp_path, runs, *SWEEP)
        while training_log_size(runs) == written and process.poll() is None:
            time.sleep(0.02)
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=300)
        assert process.returncode == 128 + signal.SIGTERM, output
        assert output.strip().splitlines()[-1] == "gsbench: stopped by SIGTERM; the same command goes on from here"
        assert "Traceback" not in output
        assert list(runs.glob("store/train/.*.partial/checkpoint-*.pt")), output
    process = start(environment, tmp_path, runs, *SWEEP)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    assert results_of(runs) == undisturbed
    left = [path for path in runs.rglob("*") if ".tmp" in path.name or path.name.endswith((".partial", ".removed"))]
    assert left == []

    one, other = sorted(runs.glob("attacked/*/*/*/results.json"))
    model = one.parent / "point_cloud.ply"
    content = bytearray(model.read_bytes())
    content[len(content) // 2] ^= 1
    model.write_bytes(content)
    psnr = json.loads(other.read_text())["metrics"]["psnr"]
    other.write_text(other.read_text().replace(f'"psnr": {psnr}', '"psnr": 99.0'))
    assert results_of(runs) != undisturbed
    process = start(environment, tmp_path, runs, *SWEEP)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    assert "point_cloud.ply differs" in output
    assert results_of(runs) == undisturbed


def test_two_sweeps_at_once_share_the_work(
    environment: dict[str, str], undisturbed: dict[str, Any], tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    both = [start(environment, tmp_path, runs, *SWEEP) for _ in range(2)]
    outputs = [process.communicate(timeout=300)[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], outputs
    assert results_of(runs) == undisturbed
    trained = [len(re.findall(r"train: iteration (\d+)/\1 ", output)) for output in outputs]  # said once, at the end
    assert sum(trained) == TRIALS, outputs
    assert min(trained) >= 1


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of three MiB; the test is skipped where this user may not mount one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(disk)], capture_output=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip("needs the right to mount a small tmpfs (root)")
    yield disk
    subprocess.run(["umount", "-l", str(disk)], check=True)


def test_full_disk_ends_the_sweep_in_one_line_and_more_space_mends_it(
    gsbench: Run, undisturbed: dict[str, Any], small_disk: Path
) -> None:
    sweep = [word for word in SWEEP if word not in ("-m", "densify=adc,volumetric")]
    done = gsbench("-m", *sweep, "densify=adc", "seed=0,1", GSBENCH_RUNS=str(small_disk))
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    lines = [line for line in done.stderr.strip().splitlines() if line.startswith("gsbench:")]
    assert lines == [
        f"gsbench: the disk of {small_disk} is full: free some space, and the same command goes on from here"
    ]
    subprocess.run(["mount", "-o", "remount,size=200m", str(small_disk)], check=True)
    done = gsbench(*sweep, "densify=adc", GSBENCH_RUNS=str(small_disk))
    assert done.returncode == 0, done.stderr
    ((name, results),) = results_of(small_disk).items()
    assert results == undisturbed[name]


def test_read_only_runs_folder_is_bad_input(gsbench: Run, small_disk: Path) -> None:
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    done = gsbench(*SMALL, GSBENCH_RUNS=str(small_disk))
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("gsbench:")
    assert "may not be written to" in line
    assert "GSBENCH_RUNS" in line
    assert os.listdir(small_disk) == []


def test_a_failed_trial_does_not_stop_the_others_and_retry_mends_it(gsbench: Run, tmp_path: Path) -> None:
    """One densifier is the user's own and fails while a file is absent."""
    (tmp_path / "mine.py").write_text(
        "from dataclasses import dataclass\nfrom pathlib import Path\nfrom gsbench.densify import ADC\n\n\n"
        "@dataclass\nclass Mine(ADC):\n    def begin(self, gaussians, context):\n"
        "        if not Path('mended').exists():\n            raise RuntimeError('not yet')\n"
        "        super().begin(gaussians, context)\n"
    )
    (tmp_path / "conf" / "densify").mkdir(parents=True)
    (tmp_path / "conf" / "densify" / "mine.yaml").write_text(
        "defaults: [adc, _self_]\n_target_: mine.Mine\nname: mine\n"
    )
    sweep = [
        "--config-dir",
        "conf",
        "-m",
        *SMALL,
        "name=own",
        "densify=mine,adc",
        "allow_targets=[mine]",
        "tracking=none",
    ]
    sweep += ["train.iterations=20", "eval.lpips=[]", "eval.flip=false"]
    runs = str(tmp_path / "runs")
    done = gsbench(*sweep, GSBENCH_RUNS=runs)
    assert done.returncode == 1, done.stderr
    assert "random-mine" in done.stderr
    assert "not yet" in done.stderr
    assert "1 of 2 trials done" in done.stderr
    (failed,) = Path(runs).glob("own/*/random-mine/*/failed.json")
    assert "not yet" in json.loads(failed.read_text())["traceback"]
    status = gsbench("status", "own", GSBENCH_RUNS=runs)
    assert status.returncode == 1
    assert "failed" in status.stdout
    assert "not yet" in status.stdout
    assert "2 trials: 1 done, 1 failed" in status.stdout
    (tmp_path / "mended").touch()
    retried = gsbench("retry", "own", "allow_targets=[mine]", GSBENCH_RUNS=runs)
    assert retried.returncode == 0, retried.stderr
    assert "1 of 1 trials done" in retried.stderr
    assert not failed.exists()
    assert gsbench("status", "own", GSBENCH_RUNS=runs).stdout.strip() == "2 trials: 2 done"
