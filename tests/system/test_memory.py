"""Peak memory of a process, on systems that count it differently."""

import sys
import types

import numpy as np
import pytest
import torch

from gsbench.system import resources as memory
from gsbench.system.resources import peak_memory_mb, peak_resident_mb, reset_peak_memory
from tests.processes import completed

CPU = torch.device("cpu")
MIB = 1_048_576
LARGE_MB = 200


def touch(megabytes):
    np.ones(megabytes * MIB, np.uint8).sum()


def test_the_peak_includes_memory_that_was_freed_again():
    before = peak_resident_mb()
    reset_peak_memory(CPU)
    touch(LARGE_MB)
    assert LARGE_MB < peak_memory_mb(CPU) < before + LARGE_MB + 200


@pytest.mark.skipif(not memory.CLEAR_REFS.exists(), reason="only Linux starts the count anew")
def test_the_peak_can_be_reset():
    touch(2 * LARGE_MB)
    high = peak_memory_mb(CPU)
    reset_peak_memory(CPU)
    assert peak_memory_mb(CPU) < high - LARGE_MB


def test_systems_without_proc_have_other_sources(tmp_path, monkeypatch):
    counted = peak_resident_mb()
    monkeypatch.setattr(memory, "STATUS", tmp_path / "missing")
    if memory.resource is not None:
        assert peak_resident_mb() == pytest.approx(counted, rel=0.5)
    monkeypatch.setattr(memory, "resource", None)
    windows = types.SimpleNamespace(memory_info=lambda: types.SimpleNamespace(peak_wset=3 * MIB))
    monkeypatch.setattr("psutil.Process", lambda: windows)
    assert peak_resident_mb() == 3


def test_the_pipeline_can_be_imported_without_the_resource_module():
    """Windows has no such module; psutil does without it."""
    code = (
        "import sys, psutil; sys.modules['resource'] = None; import gsbench.runs.keys, "
        "gsbench.bench"
    )
    completed([sys.executable, "-c", code])
