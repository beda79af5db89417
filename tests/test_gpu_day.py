"""scripts/gpu_day.sh as a whole without a GPU, so that no line of it fails for the first time where time is short."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from tests.raster.conftest import interpreter_fault

ROOT = Path(__file__).resolve().parents[1]
SCRIPT = ROOT / "scripts" / "gpu_day.sh"
# As compute-sanitizer is called: its own options, then the command.
CHECKER = """#!/bin/sh
while :; do case $1 in --tool | --error-exitcode) shift 2 ;; *) break ;; esac; done
exec "$@"
"""

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs bash and Triton")


def run(state: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {
        "GPU_DAY_TINY": "1",
        "GPU_DAY_STATE": str(state),
        "GPU_DAY_BROUGHT": str(state / "nothing"),
        "OUT": str(state),
        "PYTHON": sys.executable,
        "PATH": f"{state}{os.pathsep}{os.environ['PATH']}",
    }
    return subprocess.run(
        ["bash", str(SCRIPT), *words], env=environment, capture_output=True, text=True, check=False, timeout=1500
    )


@pytest.mark.slow
def test_the_whole_day_in_the_interpreter(tmp_path: Path) -> None:
    triton = pytest.importorskip("triton")
    if fault := interpreter_fault(triton.__version__, version("numpy")):
        pytest.skip(fault)
    (tmp_path / "compute-sanitizer").write_text(CHECKER)
    (tmp_path / "compute-sanitizer").chmod(0o755)
    for part in ("setup", "check", "speed", "train"):
        done = run(tmp_path, part)
        assert done.returncode == 0, done.stdout + done.stderr
        assert (tmp_path / f"gpu_day-{part}.tar.gz").stat().st_size > 0
    said = run(tmp_path, "table").stdout
    assert "- contract: yes (" in said
    assert "- the same bits, three times: yes\n" in said
    assert "- memory checker: yes" in said
    assert "did not end well" not in said
    assert re.search(r"^\| trained \| 3 \| 16x16 \| `triton` \| [\d.]+ \|", said, re.MULTILINE)
    assert re.search(r"^\| a trained bonsai \| \d+ \| 16x16 \| `cpu` \|", said, re.MULTILINE)
    assert re.search(r"^\| `triton` \| 2 \| \d+ \| [\d.]+ \| \d+ \| [\d.]+ \| [\d.]+ \|$", said, re.MULTILINE)


def test_what_it_brings_is_pinned() -> None:
    """Each package that is brought along stands in constraints.txt under that name."""
    pinned = {line.split("==")[0] for line in (ROOT / "constraints.txt").read_text().splitlines()}
    text = SCRIPT.read_text()
    (wheels,), (sources,) = (re.findall(rf"^{name}=\(([^)]+)\)", text, re.MULTILINE) for name in ("WHEELS", "SOURCES"))
    assert set(wheels.split()) | set(sources.split()) <= pinned
    assert "gsplat" in wheels


def test_a_table_of_what_failed(tmp_path: Path) -> None:
    """A day on which little went well still gives a table, which says so."""
    results = tmp_path / "results"
    results.mkdir()
    assert run(tmp_path, "table").stdout.startswith("Measured on: unknown.")
    (results / "steps.tsv").write_text("contract\t1\t9\nbits\t1\t5\nbench-random-10\tlate\t0\ncontract\t0\t8\n")
    (results / "contract.out").write_text("....\n==== 31 passed in 9 s ====\n")
    (results / "bits.out").write_text(json.dumps({"differing": ["image", "gradient of means"]}))
    (results / "bench-random-10.out").write_text("")
    row = {"raster": "triton", "scene": "random", "count": 1000, "size": "16x16", "step_ms": 1.234, "step_ratio": 1.0}
    (results / "bench-random-1000.out").write_text(json.dumps([row]))
    (results / "train-gsplat.json").write_text(json.dumps({"raster": "gsplat", "num_gaussians": 12345, "metrics": {}}))
    said = run(tmp_path, "table").stdout
    assert "- contract: yes (31 passed in 9 s)" in said
    assert "NO (exit 1); different: image, gradient of means" in said
    assert "- memory checker: not tried" in said
    assert "**did not end well**: bits (1), bench-random-10 (late)" in said
    assert "| random | 1,000 | 16x16 | `triton` | - | - | - | - | 1.23 | - | - | 1.00 |" in said
    assert "| `gsplat` | - | 12,345 | - | - | - | - |" in said


def test_words_that_it_does_not_know(tmp_path: Path) -> None:
    done = run(tmp_path, "everything")
    assert done.returncode == 2
    assert "scripts/gpu_day.sh wheels" in done.stdout
    assert "exit" not in done.stdout
