"""How many threads a trial may use. Loads no torch."""

from __future__ import annotations

import os


def available_threads(parallel: int = 1) -> int:
    """The CPU threads for one of ``parallel`` trials: what Slurm gave, else this process's cores, shared evenly."""
    slurm = os.environ.get("SLURM_CPUS_PER_TASK", "")
    if slurm.isdigit() and int(slurm) > 0:
        return int(slurm)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // parallel)
