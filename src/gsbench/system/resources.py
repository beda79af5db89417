"""Cores, GPUs and slots for trials that run at once on a machine, and the memory that they take at most.

Peak memory is that of the GPU where the work is there, else of this process. Loads no torch.
"""

from __future__ import annotations

import logging
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

from gsbench.system.locks import BusyError, hold

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
SECONDS_BETWEEN_TRIES = 0.5
CORES_OF_TRIAL = 4  # beyond, more trials at once gain more than more threads of one
MEMORY_OF_TRIAL, MEMORY_OF_GAUSSIAN = 545 * 2**20, 1592  # bytes, of a training on the CPU
USUAL_GAUSSIANS = 1_000_000  # where nothing limits them
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")

log = logging.getLogger(__name__)


def available_threads(parallel: int = 1) -> int:
    """The CPU threads for one of ``parallel`` trials: what Slurm gave, else this process's cores, shared evenly."""
    slurm = os.environ.get("SLURM_CPUS_PER_TASK", "")
    if slurm.isdigit() and int(slurm) > 0:
        return int(slurm)
    return max(1, available_cores() // parallel)


@cache
def trials_at_once(max_gaussians: int | None, device: str) -> int:
    """The number of trials that use this machine well: by its GPUs where they train, else by its cores and memory."""
    if device != "cpu" and (gpus := installed_gpus()):
        return len(gpus)
    cores = available_cores()
    needed = MEMORY_OF_TRIAL + MEMORY_OF_GAUSSIAN * (max_gaussians or USUAL_GAUSSIANS)
    in_memory = psutil.virtual_memory().total // needed
    return max(1, min(max(min(2, cores), cores // CORES_OF_TRIAL), in_memory))


@contextmanager
def take_slot(runs: Path, count: int) -> Iterator[int]:
    """Hold the first free one of ``count`` slots of this machine: no more trials run at once, whoever started them."""
    folder = runs / ".slots" / socket.gethostname()
    folder.mkdir(parents=True, exist_ok=True)
    while True:
        for slot in range(count):
            with ExitStack() as stack:
                try:
                    stack.enter_context(hold(folder / f"{slot}.lock", f"slot {slot}", wait=False))
                except BusyError:
                    continue
                yield slot
                return
        time.sleep(SECONDS_BETWEEN_TRIES)


def assign_gpu(slot: int, visible: str | None) -> None:
    """Let this process see one GPU: the slot's turn among those that the parent saw. Before torch is loaded."""
    gpus = [gpu.strip() for gpu in visible.split(",") if gpu.strip()] if visible is not None else installed_gpus()
    if gpus:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[slot % len(gpus)]
    elif visible is None:
        os.environ.pop("CUDA_VISIBLE_DEVICES", None)  # submitit has emptied it


def installed_gpus() -> list[str]:
    """The indices of NVIDIA GPUs of this machine, as its driver lists them."""
    try:
        listing = subprocess.run(
            ["nvidia-smi", "--query-gpu=index", "--format=csv,noheader"],
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return []
    return listing.stdout.split()


def assign_threads(threads: int | str, parallel: int) -> None:
    """Limit the libraries' threads in this process to ``threads``, for "auto" to its share. Before torch is loaded."""
    count = available_threads(parallel) if threads == "auto" else int(threads)
    for variable in THREAD_VARIABLES:
        os.environ[variable] = str(count)


def available_cores() -> int:
    """The cores that this process may use, at least 1."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# ---- memory


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
    return float(psutil.Process().memory_info().peak_wset) / MIB


def peak_child_mb() -> float:
    """The most that any one ended child of this process had resident; MiB, 0 where the platform does not say."""
    return 0.0 if resource is None else _max_resident_mb(resource.RUSAGE_CHILDREN)


def _max_resident_mb(who: int) -> float:
    unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss: bytes there, else kB
    return resource.getrusage(who).ru_maxrss * unit / MIB
