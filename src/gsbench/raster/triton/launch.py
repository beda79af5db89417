"""Start of the Triton kernels: the tools that a machine needs for the first one, and how each is launched.

Triton compiles the piece of C that starts its kernels. Loads neither torch nor Triton.
"""

from __future__ import annotations

import logging
import os
import shutil
import sys
import sysconfig
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.raster.executors import find

log = logging.getLogger(__name__)


def missing_tools() -> list[str]:
    """List what is missing of a C compiler and Python's headers, each with the package that has it. Loads neither torch
    nor Triton.
    """
    missing = []
    compiler = os.environ.get("CC")
    found = shutil.which(compiler.split()[0]) if compiler else shutil.which("gcc") or shutil.which("clang")
    if found is None:
        named = f" (CC is {compiler}, which is not there)" if compiler else ""
        missing.append(f"a C compiler{named}: install the package gcc")
    scheme = sysconfig.get_default_scheme()
    if scheme == "posix_local":  # Debian's own; the headers are where they always were
        scheme = "posix_prefix"
    header = Path(sysconfig.get_paths(scheme=scheme)["include"]) / "Python.h"
    if not header.exists():
        version = f"{sys.version_info.major}.{sys.version_info.minor}"
        missing.append(f"{header}: install the package python{version}-dev (python{version}-devel on Fedora)")
    return missing


@cache
def load_driver() -> None:
    """Let Triton find the GPU and load its launcher, compiling it if need be; InputError says what is missing."""
    try:
        from triton import knobs
        from triton.runtime import driver

        if not Path(knobs.cache.dir).exists():
            log.info("compiling the GPU kernels, once: they are kept in %s", knobs.cache.dir)
        driver.active.get_current_target()
    except (RuntimeError, OSError, AssertionError, ImportError) as error:
        missing = missing_tools()
        reason = "Triton needs " + " and ".join(missing) if missing else f"Triton cannot start: {error}"
        if old := find("triton").too_old():
            reason = f"raster=triton {old}"
        raise InputError(reason) from error


# Products and sums are contracted to fma: Triton's default today, but no longer from 3.10 on.
OPTIONS = {"enable_fp_fusion": True}


def launch(kernel: Any, count: int, group: int) -> Callable[..., None]:
    """``kernel`` for ``count`` items, a lane an item and ``group`` a program; nothing at all for no items."""

    def run(*arguments: Any, **constants: Any) -> None:
        if count:
            launch_grid(kernel, -(-count // group))(*arguments, GROUP=group, **constants)

    return run


def launch_grid(kernel: Any, *programs: int) -> Callable[..., None]:
    """``kernel`` for a grid of ``programs``, at least one along each axis; ``num_warps`` is named beside constants."""

    def run(*arguments: Any, **constants: Any) -> None:
        kernel[programs](*arguments, **OPTIONS, **constants)

    return run
