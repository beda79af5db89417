"""The table of gsbench's executors, and the settings that choose one. Does not import torch.

A rasterizer of your own needs no entry: ``raster._target_=mine.MyRasterizer`` (docs/rasterizer.md).
"""

import importlib.util
import logging
import os
import shutil
import sys
import sysconfig
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from gsbench.errors import InputError
from gsbench.parsing import table_beside
from gsbench.settings import MISSING, TargetName, check_settings
from gsbench.words import did_you_mean

log = logging.getLogger(__name__)

AUTO = "auto"


@dataclass(frozen=True)
class Executor:
    """Facts of an executor that are known before its module is imported."""

    name: str  # as in ``raster=NAME``, in results and in tables
    target: str  # import path of its class
    text: str  # description in one line
    devices: Sequence[str] = ()  # types of torch devices that it runs on; empty: all
    package: str | None = None  # a package that it needs beyond gsbench's own requirements
    install: str = ""  # how to get that package
    takes_threads: bool = False  # its class has an argument ``threads``
    same_bits: bool = True  # two runs on a device give the same bits

    @property
    def is_installed(self) -> bool:
        """Return whether its package is installed; imports nothing."""
        return self.package is None or importlib.util.find_spec(self.package) is not None

    def runs_on(self, device_type: str) -> bool:
        return not self.devices or device_type in self.devices

    def obstacle(self, device_type: str) -> str | None:
        """The reason why it cannot run on this type of device, with a remedy; None if it can."""
        if not self.runs_on(device_type):
            needed = " or ".join(self.devices)
            alternatives = ", ".join(
                other.name for other in EXECUTORS if other.runs_on(device_type)
            )
            return (
                f"runs on device={needed}, not on {device_type}; choose from {alternatives}, "
                f"or set device={needed}"
            )
        return None if self.is_installed else f"needs {self.package}: {self.install}"


EXECUTORS = tuple(Executor(**row) for row in table_beside(__file__, "executors.yaml"))
if os.environ.get("TRITON_INTERPRET") == "1":  # for tests: then its kernels run on the CPU, too
    *_others, _triton = EXECUTORS
    EXECUTORS = (*_others, replace(_triton, devices=("cuda", "cpu")))


def names() -> tuple[str, ...]:
    """The names that ``raster=`` accepts."""
    return (AUTO, *(executor.name for executor in EXECUTORS))


def find_executor(name: str) -> Executor:
    """Return the executor called ``name``.

    Raises InputError, which lists the names, if there is none.
    """
    for executor in EXECUTORS:
        if executor.name == name:
            return executor
    raise InputError(
        f"raster={name} is not known; choose {', '.join(names())}, or set raster._target_ to a "
        f"class of your own{did_you_mean(name, names())}"
    )


def lacks(name: str, own: object, needs_footprint: bool, extra: str | None) -> str | None:
    """Say which optional output the rasterizer called ``name`` lacks, with a remedy, or None.

    The outputs are the footprint, if needed, and the extra output called ``extra``. The executors
    of gsbench give all; the attributes of another rasterizer, ``own``, say what it gives.
    """
    known = [executor.name for executor in EXECUTORS]
    if name in known or name == AUTO:
        return None
    if needs_footprint and not getattr(own, "has_footprint", False):
        output = "footprints"
    elif extra is not None and extra not in getattr(own, "extras", ()):
        output = f"the extra output {extra}"
    else:
        return None
    able = " or ".join(f"raster={other}" for other in known)
    return f"needs {output}, which raster={name} does not give; take {able}"


def resolve(name: str, device_type: str) -> Executor:
    """Return the executor called ``name``, or for ``auto`` the best one for this type of device.

    Raises InputError if it cannot run there. ``auto`` logs a warning if only the slow reference can
    run.
    """
    if name == AUTO:
        first, *_ = automatic(device_type)
        return first
    executor = find_executor(name)
    if (obstacle := executor.obstacle(device_type)) is not None:
        raise InputError(f"raster={name} {obstacle}")
    return executor


def automatic(device_type: str) -> list[Executor]:
    """The executors that ``auto`` may take on a device of this type, the best first.

    The last one is the reference. Logs a warning if no other can run.
    """
    candidates = [executor for executor in EXECUTORS if device_type in executor.devices]
    usable = [executor for executor in candidates if executor.obstacle(device_type) is None]
    if not usable:
        hints = "; ".join(
            f"{executor.name} needs {executor.package}: {executor.install}"
            for executor in candidates
        )
        log.warning(
            "raster=auto: the slow reference rasterizer runs%s", f" ({hints})" if hints else ""
        )
    return [*usable, find_executor("reference")]


def missing_tools() -> list[str]:
    """List what Triton lacks to compile the C code that launches its kernels.

    It needs a C compiler and Python's headers. Each line names the package to install.
    """
    missing = []
    compiler = os.environ.get("CC")
    path = (
        shutil.which(compiler.split()[0])
        if compiler
        else shutil.which("gcc") or shutil.which("clang")
    )
    if path is None:
        named = f" (CC is {compiler}, which is not there)" if compiler else ""
        missing.append(f"a C compiler{named}: install the package gcc")
    scheme = sysconfig.get_default_scheme()
    # Debian's scheme for packages; its headers are still in the usual place
    if scheme == "posix_local":
        scheme = "posix_prefix"
    header = Path(sysconfig.get_paths(scheme=scheme)["include"]) / "Python.h"
    if not header.exists():
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        missing.append(
            f"{header}: install the package python{version}-dev (python{version}-devel on Fedora)"
        )
    return missing


@cache
def load_driver() -> None:
    """Make Triton load its launcher for the GPU, which Triton may have to compile first.

    Raises InputError that says what is missing.
    """
    try:
        from triton import knobs
        from triton.runtime import driver

        if not Path(knobs.cache.dir).exists():
            log.info("compiling the GPU kernels, once: they are kept in %s", knobs.cache.dir)
        driver.active.get_current_target()
    except (RuntimeError, OSError, AssertionError, ImportError) as error:
        missing = missing_tools()
        reason = (
            "Triton needs " + " and ".join(missing) if missing else f"Triton cannot start: {error}"
        )
        raise InputError(reason) from error


@dataclass
class RasterConfig:
    name: str = MISSING  # auto, or an executor of gsbench.raster.executors
    _target_: TargetName | None = None  # a class of your own instead; its options are further keys

    def __post_init__(self) -> None:
        check_settings(self, "raster")
        if self._target_ is None and self.name != AUTO:
            find_executor(self.name)
