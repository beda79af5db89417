"""The Triton rasterizer without a GPU: runs its tests in Triton's interpreter, by parts.

Each part runs in a separate process.
"""

import os
import sys
from pathlib import Path
from shlex import split

import numpy as np
import pytest

from tests.processes import completed

pytest.importorskip("triton")

import triton

from tests.raster.conftest import interpreter_fault

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
CONTRACT = "tests/raster/test_contract.py"
INTERPRETED = "tests/raster/test_triton_interpreted.py"
EVERY = "match_the_reference"
ONE_SCENE = "33x49"  # several tiles each way, the last ones of one pixel, harmonics of all degrees
PARTS = {
    "contract": [CONTRACT, "-k", f"triton and (not {EVERY} or {ONE_SCENE})"],
    "every scene": [CONTRACT, "-k", f"triton and {EVERY} and not {ONE_SCENE}"],
    "kernels and training": [INTERPRETED],
}
# s; stops a part that hangs, before the limit of a test in pyproject.toml does. A part takes minutes.
LIMIT = 1700


@pytest.mark.parametrize("part", PARTS)
def test_a_part_passes_in_the_interpreter(part):
    if fault := interpreter_fault(triton.__version__, np.__version__):
        pytest.skip(fault)
    environment = os.environ | {
        "TRITON_INTERPRET": "1",
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join(path for path in [str(ROOT), *sys.path] if path),
    }
    words = [
        sys.executable,
        *split("-m pytest -q -x --no-header -p no:cacheprovider"),
        *PARTS[part],
    ]
    done = completed(words, cwd=ROOT, env=environment, timeout=LIMIT)
    assert " passed" in done.stdout


@pytest.mark.parametrize(
    "versions, works",
    [
        (("3.6.0", "2.4.0"), False),
        (("3.6.0", "2.10.1"), False),
        (("3.6.0", "2.3.5"), True),
        (("3.4.0", "1.26.4"), True),
        (("3.7.1", "2.4.6"), True),
        (("3.10.0", "2.5.2"), True),
    ],
)
def test_versions_of_triton_and_numpy_that_do_not_fit_are_known(versions, works):
    assert (interpreter_fault(*versions) is None) == works


def test_every_test_is_in_exactly_one_part():
    environment = os.environ | {"TRITON_INTERPRET": "1"}

    def collected(arguments):
        words = [
            sys.executable,
            *split("-m pytest -q --collect-only -p no:cacheprovider"),
            *arguments,
        ]
        done = completed(words, cwd=ROOT, env=environment)
        return [line for line in done.stdout.splitlines() if "::" in line]

    everything = [name for name in collected([CONTRACT, INTERPRETED]) if "triton" in name]
    parts = [name for arguments in PARTS.values() for name in collected(arguments)]
    assert sorted(parts) == sorted(everything)
