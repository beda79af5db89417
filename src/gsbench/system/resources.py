"""Cores, GPUs and slots for trials that run at once on a machine; devices of torch, and memory.

Loads torch only in functions about its devices. For work on a GPU, peak memory is that of the GPU,
else that of this process.
"""

from __future__ import annotations

import logging
import os
import re
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import psutil

from gsbench.errors import InputError
from gsbench.system.locks import BusyError, hold
from gsbench.system.programs import answer_of

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

if TYPE_CHECKING:
    import torch

T = TypeVar("T")
R = TypeVar("R")

MIB = 2**20
STATUS = Path("/proc/self/status")
CLEAR_REFS = Path("/proc/self/clear_refs")
# Texts of torch, numpy and C++ for memory that cannot be allocated; most come as RuntimeError.
NO_MEMORY = re.compile(
    r"out of memory|allocat\w+ memory|not enough memory|bad_alloc|unable to allocate", re.I
)
RESET_PEAK = "5"  # makes Linux reset VmHWM, see proc(5)
SECONDS_BETWEEN_TRIES = 0.5
CORES_OF_TRIAL = 4  # with more cores, more trials at once gain more than more threads per trial
MEMORY_OF_TRIAL, MEMORY_OF_GAUSSIAN = 545 * 2**20, 1592  # bytes, of a training on the CPU
USUAL_GAUSSIANS = 1_000_000  # assumed count without a cap
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)

log = logging.getLogger(__name__)


def available_threads(parallel: int = 1) -> int:
    """The number of CPU threads for one of ``parallel`` trials.

    It is the number that Slurm gives a task, else an equal share of the cores.
    """
    slurm = os.environ.get("SLURM_CPUS_PER_TASK", "")
    if slurm.isdigit() and int(slurm) > 0:
        return int(slurm)
    return max(1, available_cores() // parallel)


def in_threads(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """The results of ``function`` for ``items``, in their order, computed on all threads."""
    with ThreadPoolExecutor(available_threads()) as pool:
        yield from pool.map(function, items)


@cache
def trials_at_once(max_gaussians: int | None, device: str) -> int:
    """A good number of trials at once.

    It is 1 for one GPU by its number, the number of GPUs for training on GPUs, else what cores and
    memory allow.
    """
    if names_one_gpu(device):
        return 1
    if device != "cpu" and (gpus := installed_gpus()):
        return len(gpus)
    cores = available_cores()
    needed = MEMORY_OF_TRIAL + MEMORY_OF_GAUSSIAN * (max_gaussians or USUAL_GAUSSIANS)
    in_memory = psutil.virtual_memory().total // needed
    return max(1, min(max(min(2, cores), cores // CORES_OF_TRIAL), in_memory))


def lacks_memory(error: Exception) -> bool:
    """Return whether an error says that no memory is left, on a GPU or on this machine."""
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and NO_MEMORY.search(str(error)) is not None
    )


@contextmanager
def take_slot(runs: Path, count: int) -> Iterator[int]:
    """Hold the first free one of ``count`` slots of this machine, and yield its number.

    The slots limit the trials of all commands together. Waits until one is free.
    """
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
    """Let this process see one of the GPUs that its parent saw (``visible``), chosen by ``slot``.

    Call it before importing torch.
    """
    gpus = (
        [gpu.strip() for gpu in visible.split(",") if gpu.strip()]
        if visible is not None
        else installed_gpus()
    )
    if gpus:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[slot % len(gpus)]
    elif visible is None:
        os.environ.pop("CUDA_VISIBLE_DEVICES", None)  # submitit has set it to an empty value


def names_one_gpu(device: str) -> bool:
    """Return whether ``device`` names a GPU by its number, as cuda:1; all trials then use it."""
    return device.startswith("cuda:")


def installed_gpus() -> list[str]:
    """The indices of the NVIDIA GPUs of this machine, from its driver."""
    return nvidia_smi("index")


def nvidia_smi(query: str) -> list[str]:
    """The answers of ``nvidia-smi --query-gpu=QUERY``, one for each GPU; [] without a driver."""
    listing = answer_of(["nvidia-smi", f"--query-gpu={query}", "--format=csv,noheader"], 60)
    return (listing or "").split()


def assign_threads(threads: int | str, parallel: int) -> None:
    """Limit threads of libraries in this process to ``threads`` ("auto": its share).

    Call it before importing torch.
    """
    count = available_threads(parallel) if threads == "auto" else int(threads)
    for variable in THREAD_VARIABLES:
        os.environ[variable] = str(count)


def available_cores() -> int:
    """The number of cores that this process may use, at least 1."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# ---- the torch device that a setting names, its precision and its memory


def select_device(name: str, setting: str = "device") -> torch.device:
    """Return the device called ``name``; ``auto`` is the GPU if torch can use one, else the CPU.

    On a GPU, float32 is then not rounded to TF32 (`disable_tf32`). Raises InputError, which names
    the ``setting``, for a device that is not there or that another program holds.
    """
    import torch

    available = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(available if name == "auto" else name)
    except RuntimeError as error:
        raise InputError(
            f"{setting}={name} is not known to torch; use auto, cpu, cuda or cuda:1"
        ) from error
    if device.type != "cuda":
        return device
    if available == "cpu":
        raise InputError(
            f"{setting}={name}: torch finds no CUDA device here; use {setting}=cpu, or install "
            "torch for CUDA"
        )
    if (device.index or 0) >= (count := torch.cuda.device_count()):
        raise InputError(f"{setting}={name}: there are {count} CUDA devices, numbered from 0")
    disable_tf32()
    try:
        torch.cuda.mem_get_info(device)
    except RuntimeError as error:
        reason = str(error).partition("\n")[0]
        raise InputError(
            f"{setting}={name}: {reason}; does another program hold the GPU (see nvidia-smi)?"
        ) from error
    return device


def disable_tf32() -> None:
    """Make GPUs compute float32 without rounding to TF32, in the whole process and in all passes.

    By default torch lets cuDNN's convolutions round to TF32, which has 10 bits. SSIM subtracts
    nearly equal moments: with TF32 its map had errors of up to 350, and its gradient was noise.
    """
    import torch

    torch.backends.cudnn.allow_tf32 = False
    torch.backends.cuda.matmul.allow_tf32 = False


def free_bytes(device: torch.device) -> int | None:
    """The bytes of a GPU's memory that torch can still use; None for a CPU."""
    if device.type != "cuda":
        return None
    import torch

    free, _ = torch.cuda.mem_get_info(device)
    # torch's cache counts as used for the driver, but torch itself can still use it.
    return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)


# ---- peak memory


def reset_peak_memory(device: torch.device) -> None:
    """Start a new measurement of peak memory, if the platform supports it (Linux, CUDA)."""
    if device.type == "cuda":
        import torch

        torch.cuda.reset_peak_memory_stats(device)
        return
    try:
        CLEAR_REFS.write_text(RESET_PEAK)
    except OSError:
        log.debug("peak memory cannot be reset here: it counts from the start of the process")


def peak_memory_mb(device: torch.device) -> float:
    """Peak memory since `reset_peak_memory`, MiB.

    On a GPU it is that of torch's allocations, else this process's resident memory.
    """
    if device.type == "cuda":
        import torch

        return torch.cuda.max_memory_allocated(device) / MIB
    return peak_resident_mb()


def peak_resident_mb() -> float:
    """The peak resident memory of this process, MiB.

    On Linux it is VmHWM: ``ru_maxrss`` cannot be reset, and starts at the memory of the parent.
    """
    if STATUS.exists() and (peak := re.search(r"VmHWM:\s+(\d+) kB", STATUS.read_text())):
        return int(peak[1]) * 1024 / MIB
    if resource is not None:
        return _max_resident_mb(resource.RUSAGE_SELF)
    return float(psutil.Process().memory_info().peak_wset) / MIB


def peak_child_mb() -> float:
    """The largest peak resident memory of an ended child of this process, MiB; 0 if not known."""
    return 0.0 if resource is None else _max_resident_mb(resource.RUSAGE_CHILDREN)


def _max_resident_mb(who: int) -> float:
    unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss: bytes there, else kB
    return resource.getrusage(who).ru_maxrss * unit / MIB


@dataclass
class CompileClock:
    """Seconds in which this process compiled kernels, loaded them, or waited for another process.

    It does not know how kernels are compiled, so that whoever reads it need not load numba.
    """

    seconds: float = 0.0
    reported: float = 0.0

    def report(self) -> float:
        """The seconds since the last report."""
        earlier, self.reported = self.reported, self.seconds
        return self.seconds - earlier


CLOCK = CompileClock()
