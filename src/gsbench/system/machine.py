"""Description of the machine, which may change a result though code, settings and seed are equal.

Compiled kernels, torch and the linear algebra libraries choose their instructions by the processor; fused and wider
ones round differently. So results are equal to the bit on one kind of machine, and close on two (see
docs/reproducibility.md).
"""

from __future__ import annotations

import contextlib
import functools
import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbench.errors import InputError

if TYPE_CHECKING:
    import torch

CPU_INFO = Path("/proc/cpuinfo")
CPU_NAME_KEYS = ("model name", "Processor", "cpu model", "Model", "cpu")  # x86, old ARM, MIPS, Raspberry Pi, POWER
# Features that x86-64-v2 to -v4 ask for beyond the level below, as far as they tell processors apart (x86-64 psABI,
# table 3.1); names are LLVM's.
X86_LEVELS = {
    "x86-64-v2": ("cx16", "sahf", "popcnt", "sse3", "sse4.1", "sse4.2", "ssse3"),
    "x86-64-v3": ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"),
    "x86-64-v4": ("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"),
}
SECONDS_FOR_SYSCTL = 10
LEAST_OF_NUMBA = {"NUMBA_NUM_THREADS": 1, "NUMBA_DISABLE_JIT": 0}  # variables that it reads as whole numbers


def describe_machine(device: torch.device) -> dict[str, str]:
    """Describe this machine as results name it: ``cpu``, ``architecture``, ``kernels``, ``torch``, ``device``.

    ``kernels`` is the processor type that the compiled kernels are made for, and its instruction set; ``torch`` the
    instruction set that torch uses; ``device`` the GPU's name, or "cpu".
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
    """One phrase for a record of `describe_machine`; results with equal phrases may be compared to the bit."""
    cpu = f"{record['cpu']} ({record['kernels']}, torch {record['torch']})"
    return cpu if record["device"] == "cpu" else f"{record['device']}, {cpu}"


@functools.cache
def cpu_name() -> str:
    """The processor's name as its system gives it; its architecture where it gives none."""
    name = {"linux": _linux_name, "darwin": _mac_name, "win32": _windows_name}.get(sys.platform, str)()
    return " ".join((name or platform.processor() or platform.machine() or "unknown").split())


def _linux_name() -> str:
    try:
        lines = CPU_INFO.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    entries: dict[str, str] = {}
    for line in lines:
        key, _, value = line.partition(":")
        entries.setdefault(key.strip(), value.strip())
    named = next((entries[key] for key in CPU_NAME_KEYS if entries.get(key)), "")
    if named or "CPU part" not in entries:
        return named
    return f"ARM implementer {entries.get('CPU implementer', '?')} part {entries['CPU part']}"  # 64-bit ARM has no name


def _mac_name() -> str:
    try:
        asked = subprocess.run(
            ["sysctl", "-n", "machdep.cpu.brand_string"],
            capture_output=True,
            text=True,
            timeout=SECONDS_FOR_SYSCTL,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return asked.stdout


def _windows_name() -> str:
    return os.environ.get("PROCESSOR_IDENTIFIER", "")


def load_numba() -> Any:
    """The module numba. Raises InputError where a variable of its own keeps it from being loaded."""
    for name, least in LEAST_OF_NUMBA.items():
        value = os.environ.get(name, str(least))
        if not value.isascii() or not value.isdigit() or int(value) < least:
            raise InputError(f"{name}={value}: numba needs a whole number from {least} on: set another, or unset it")
    # numba takes settings from `.numba_config.yaml` of the current folder, in which a stranger's capture may lie.
    with contextlib.chdir(Path(__file__).parent):
        import numba
        from numba.core import config
    config._config_fname = ""  # which it reads again at compilations
    return numba


def numba_target() -> tuple[str, str]:
    """The processor that numba compiles for and its features, as LLVM writes them ("+sse2,-avx512f,…")."""
    import llvmlite.binding

    numba = load_numba()
    config: Any = numba.config  # its settings are made at run time
    features = config.CPU_FEATURES
    if features is None:
        features = llvmlite.binding.get_host_cpu_features().flatten()
    return str(config.CPU_NAME or llvmlite.binding.get_host_cpu_name()), str(features)


def kernel_target() -> str:
    """The target of numba, LLVM's name and the x86-64 level: this processor, or ``NUMBA_CPU_NAME``."""
    name, features = numba_target()
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return name
    return f"{name}, {x86_level({feature[1:] for feature in features.split(',') if feature.startswith('+')})}"


def x86_level(features: set[str]) -> str:
    """The highest x86-64 micro-architecture level whose features (LLVM's names) are all there."""
    level = "x86-64-v1"
    for name, wanted in X86_LEVELS.items():
        if not features.issuperset(wanted):
            break
        level = name
    return level
