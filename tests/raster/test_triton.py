"""The Triton rasterizer without a GPU: its tests in Triton's interpreter, each part in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("triton")

ROOT = Path(__file__).resolve().parents[2]
CONTRACT = "tests/raster/test_contract.py"
# About equally long; they run side by side.
PARTS = {
    "contract": [CONTRACT, "-k", "triton and match"],
    "rest": [CONTRACT, "tests/raster/test_triton_interpreted.py", "-k", "triton and not match"],
}
LIMIT = 3600  # s, for one that hangs; minutes on a quiet machine, and 15 were too few on two cores with a load of 20


@pytest.fixture(scope="module")
def interpreted() -> Iterator[dict[str, subprocess.Popen[str]]]:
    """All parts, started together."""
    environment = os.environ | {
        "TRITON_INTERPRET": "1",
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join(path for path in [str(ROOT), *sys.path] if path),
    }
    processes = {
        part: subprocess.Popen(
            [sys.executable, "-m", "pytest", "-q", "-x", "--no-header", "-p", "no:cacheprovider", *arguments],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for part, arguments in PARTS.items()
    }
    yield processes
    for process in processes.values():
        process.kill()
        process.wait()


@pytest.mark.parametrize("part", PARTS)
def test_in_the_interpreter(interpreted: dict[str, subprocess.Popen[str]], part: str) -> None:
    output, _ = interpreted[part].communicate(timeout=LIMIT)
    print(output)
    assert interpreted[part].returncode == 0, output
    assert " passed" in output
