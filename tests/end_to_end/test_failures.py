"""The program with a full disk."""

import subprocess
from shlex import split

import pytest

from tests.end_to_end.conftest import SWEEP, results_of

pytestmark = pytest.mark.slow


def test_a_full_disk_ends_the_sweep_in_one_line_and_it_continues_with_more_space(
    gsbench, undisturbed, small_disk
):
    sweep = [word for word in SWEEP if word not in ("-m", "densify=adc,volumetric")]
    done = gsbench("-m", *sweep, "densify=adc", "seed=0,1", code=1, GSBENCH_RUNS=str(small_disk))
    assert "Traceback" not in done.stderr
    lines = [line for line in done.stderr.strip().splitlines() if line.startswith("gsbench:")]
    assert lines == [
        f"gsbench: the disk of {small_disk} is full: free some space, then give the same command "
        "again: it continues"
    ]
    subprocess.run(split(f"mount -o remount,size=200m {small_disk}"), check=True)
    done = gsbench(*sweep, "densify=adc", GSBENCH_RUNS=str(small_disk))
    ((name, results),) = results_of(small_disk, "attacked").items()
    assert results == undisturbed[name]
