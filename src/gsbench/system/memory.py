"""Peak memory: of the GPU where the work is there, else of this process."""

from __future__ import annotations

import logging
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

if TYPE_CHECKING:
    import torch

MIB = 2**20
STATUS = Path("/proc/self/status")
CLEAR_REFS = Path("/proc/self/clear_refs")
RESET_PEAK = "5"  # what Linux takes as "start VmHWM anew", see proc(5)

log = logging.getLogger(__name__)


def reset_peak_memory(device: torch.device) -> None:
    """Start a new measurement of peak memory, where the platform can (Linux, CUDA)."""
    if device.type == "cuda":
        import torch

        torch.cuda.reset_peak_memory_stats(device)
        return
    try:
        CLEAR_REFS.write_text(RESET_PEAK)
    except OSError:
        log.debug("peak memory cannot be reset here: it counts from the start of the process")


def peak_memory_mb(device: torch.device) -> float:
    """Peak since `reset_peak_memory`: of torch's allocations on a GPU, else of this process's resident memory; MiB."""
    if device.type == "cuda":
        import torch

        return torch.cuda.max_memory_allocated(device) / MIB
    return peak_resident_mb()


def peak_resident_mb() -> float:
    """The most memory that this process had resident; MiB.

    Linux's own count comes first: ``ru_maxrss`` begins at what the parent had when it started this process, and cannot
    be reset.
    """
    if STATUS.exists():
        found = re.search(r"VmHWM:\s+(\d+) kB", STATUS.read_text())
        if found:
            return int(found.group(1)) * 1024 / MIB
    if resource is not None:
        return _max_resident_mb(resource.RUSAGE_SELF)
    import psutil

    return float(psutil.Process().memory_info().peak_wset) / MIB


def peak_child_mb() -> float:
    """The most that any one ended child of this process had resident; MiB, 0 where the platform does not say."""
    return 0.0 if resource is None else _max_resident_mb(resource.RUSAGE_CHILDREN)


def _max_resident_mb(who: int) -> float:
    unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss: bytes there, else kB
    return resource.getrusage(who).ru_maxrss * unit / MIB
