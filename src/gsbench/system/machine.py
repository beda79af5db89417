"""Description of the machine, which can change results even if code, settings and seed are equal.

Compiled kernels, torch and linear algebra libraries choose instructions by the processor, and fused
or wider instructions round differently. So results are equal to the bit only on one kind of machine
(docs/reproducibility.md).
"""

from __future__ import annotations

import contextlib
import functools
import os
import platform
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbench.errors import InputError

if TYPE_CHECKING:
    import torch

CPU_INFO = Path("/proc/cpuinfo")
# x86, old ARM, MIPS, Raspberry Pi, POWER
CPU_NAME_KEYS = ("model name", "Processor", "cpu model", "Model", "cpu")
# Features that each level requires beyond the level before it, as far as they distinguish
# processors (x86-64 psABI, table 3.1), by their LLVM names.
X86_LEVELS = {
    "x86-64-v2": ("cx16", "sahf", "popcnt", "sse3", "sse4.1", "sse4.2", "ssse3"),
    "x86-64-v3": ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"),
    "x86-64-v4": ("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"),
}
# variables that numba reads as whole numbers
NUMBA_MINIMA = {"NUMBA_NUM_THREADS": 1, "NUMBA_DISABLE_JIT": 0}


def describe_machine(device: torch.device) -> dict[str, str]:
    """Describe this machine for results: ``cpu``, ``architecture`` and three more keys.

    ``kernels`` is the processor type that kernels are compiled for, with its instruction set;
    ``torch`` is the instruction set that torch uses; ``device`` is the name of the GPU, or "cpu".
    """
    import torch

    return {
        "cpu": cpu_name(),
        "architecture": platform.machine(),
        "kernels": kernel_target(),
        "torch": torch.backends.cpu.get_cpu_capability(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else device.type,
    }


def kind_of_machine(record: Mapping[str, Any]) -> str:
    """A record of `describe_machine` as one phrase.

    Results with equal phrases can be equal to the bit.
    """
    cpu = f"{record['cpu']} ({record['kernels']}, torch {record['torch']})"
    return cpu if record["device"] == "cpu" else f"{record['device']}, {cpu}"


@functools.cache
def cpu_name() -> str:
    """The name of the processor from the operating system, else its architecture."""
    return " ".join(
        (_linux_name() or platform.processor() or platform.machine() or "unknown").split()
    )


def _linux_name() -> str:
    text = CPU_INFO.read_text(encoding="utf-8", errors="replace") if CPU_INFO.is_file() else ""
    # Each core has an entry of the same keys; the first one counts.
    entries = dict(reversed(re.findall(r"^(\w[\w ]*?)[ \t]*:[ \t]*(\S.*)$", text, re.MULTILINE)))
    named = next((entries[key] for key in CPU_NAME_KEYS if key in entries), "")
    if named or "CPU part" not in entries:
        return named
    # 64-bit ARM has only numbers there.
    return f"ARM implementer {entries.get('CPU implementer', '?')} part {entries['CPU part']}"


def load_numba() -> Any:
    """Import numba.

    Raises InputError if one of its environment variables would make the import fail.
    """
    for name, minimum in NUMBA_MINIMA.items():
        value = os.environ.get(name, str(minimum))
        if not value.isascii() or not value.isdigit() or int(value) < minimum:
            raise InputError(
                f"{name}={value}: numba needs a whole number from {minimum} on: set another, or "
                "unset it"
            )
    # numba reads `.numba_config.yaml` in the current folder, where a stranger's capture may be:
    # import it elsewhere.
    with contextlib.chdir(Path(__file__).parent):
        import numba
        from numba.core import config
    config._config_fname = ""  # else numba reads the file again when it compiles
    return numba


def numba_target() -> tuple[str, str]:
    """The processor that numba compiles for, and its features ("+sse2,-avx512f,…")."""
    import llvmlite.binding

    numba = load_numba()
    config: Any = numba.config  # Any: its attributes are made at run time
    features = config.CPU_FEATURES
    if features is None:
        features = llvmlite.binding.get_host_cpu_features().flatten()
    return str(config.CPU_NAME or llvmlite.binding.get_host_cpu_name()), str(features)


def kernel_target() -> str:
    """The LLVM name of the processor that numba compiles for and, on x86-64, its level.

    That is this processor, or the one in ``NUMBA_CPU_NAME``.
    """
    name, features = numba_target()
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return name
    return (
        f"{name}, "
        f"{x86_level({feature[1:] for feature in features.split(',') if feature.startswith('+')})}"
    )


def x86_level(features: set[str]) -> str:
    """The highest x86-64 level whose features (LLVM's names) are all in ``features``."""
    level = "x86-64-v1"
    for name, required in X86_LEVELS.items():
        if not features.issuperset(required):
            break
        level = name
    return level
