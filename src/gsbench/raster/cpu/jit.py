"""Compilation of the kernels: options, the cache on disk, and the word to the user while the first compilation runs."""

from __future__ import annotations

import functools
import hashlib
import logging
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

# What kernels import, constants included, below the package's folder.
COMPILED_FROM = (
    "raster/*.py",
    "raster/cpu/*.py",
    "gaussians/model.py",
    "gaussians/spherical_harmonics.py",
    "pipeline/ssim.py",
)
FIRST_COMPILE_SECONDS = 10  # about; measured 7.5 s of processor time on a 2024 server core

njit: Any = numba.njit
config: Any = numba.config

_logger = logging.getLogger(__name__)


def _cache_folder() -> Path:
    """Where compiled kernels are kept: a folder of its own for each state of the sources.

    numba looks at the file of a kernel, not at what that file imports, so a changed helper would leave stale machine
    code in use. The base is ``NUMBA_CACHE_DIR``, else the user's cache folder; where neither can be written, a private
    temporary folder, and the next process compiles again.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    package = Path(__file__).parents[2]
    for pattern in COMPILED_FROM:
        for source in sorted(package.glob(pattern)):
            digest.update(source.read_bytes())
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    given = os.environ.get("NUMBA_CACHE_DIR")
    for base in [*([Path(given)] if given else []), Path(home) / "gsbench" / "numba"]:
        folder = base / digest.hexdigest()[:16]
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return Path(tempfile.mkdtemp(prefix="gsbench-numba-"))


CACHE_FOLDER = _cache_folder()


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile ``function`` at its first call: without the GIL, without Python's division checks, cached on disk.

    Also without reference counts (``_nrt``), which numba would keep, atomically, at each inlined call: a kernel borrows
    all its arrays and may not allocate.
    """
    previous = config.CACHE_DIR  # read when the decorator runs; other users of numba in this process keep theirs
    config.CACHE_DIR = str(CACHE_FOLDER)
    try:
        return njit(nogil=True, cache=True, error_model="numpy", _nrt=False)(function)
    finally:
        config.CACHE_DIR = previous


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile ``function`` into the kernels that call it."""
    return njit(nogil=True, error_model="numpy", forceinline=True, _nrt=False)(function)


@functools.cache
def announce_compilation() -> None:
    """Tell the user, once, that the first call will take a while, if the cache on disk is empty."""
    if not any(CACHE_FOLDER.rglob("*.nbc")):
        _logger.warning("compiling the CPU rasterizer, about %d s, once", FIRST_COMPILE_SECONDS)
