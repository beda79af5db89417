"""Compilation of kernels by numba: options, the cache on disk, and the word to the user while something compiles."""

import functools
import hashlib
import logging
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gsbench.system.machine import load_numba, numba_target

numba = load_numba()  # before anything of it is imported by name

from numba.core import event  # noqa: E402

PACKAGE = Path(__file__).resolve().parents[1]
# Files and folders of all that goes into kernels: functions and constants. A test compares them with the imports.
SOURCES = (
    "raster/cpu",
    "raster/base.py",
    "raster/staged.py",
    "gaussians/model.py",
    "eval/ssim.py",
    "train/loss_cpu.py",
    "scene/courtyard",
    "system/jit.py",
)
DIGEST_CHARACTERS = 16
TEMPORARY_PREFIX = "gsbench-numba-"  # of the folder where no other can be written

njit: Any = numba.njit
config: Any = numba.config

_logger = logging.getLogger(__name__)


@functools.cache
def cache_base() -> Path:
    """The folder that holds compiled kernels: ``NUMBA_CACHE_DIR``, else one in the user's cache.

    Where neither can be written, a private temporary folder, and the next process compiles again.
    """
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    given = os.environ.get("NUMBA_CACHE_DIR")
    for base in [*([Path(given)] if given else []), Path(home) / "gsbench" / "numba"]:
        try:
            base.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(base, os.W_OK):
            return base
    return Path(tempfile.mkdtemp(prefix=TEMPORARY_PREFIX))


@functools.cache
def cache_folder(package: Path = PACKAGE) -> Path:
    """The folder of compiled kernels: another one for each state of what they are made of.

    numba looks at the file of a kernel, not at what that file imports, so a changed helper would leave stale machine
    code in use. The folder's name is a digest of all `SOURCES`, and of the processor: numba tells processors apart in
    an index that two machines with one home folder may write at once.
    """
    digest = hashlib.sha256("\n".join((numba.__version__, *numba_target())).encode())
    for source in SOURCES:
        place = package / source
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return cache_base() / digest.hexdigest()[:DIGEST_CHARACTERS]


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile ``function`` at its first call: without the GIL, without Python's division checks, cached on disk.

    Also without reference counts (``_nrt``), which numba would keep, atomically, at each inlined call: a kernel borrows
    all its arrays and may not allocate.
    """
    previous = config.CACHE_DIR  # read when the decorator runs; other users of numba in this process keep theirs
    config.CACHE_DIR = str(cache_folder())
    try:
        return njit(nogil=True, cache=True, error_model="numpy", _nrt=False)(function)
    finally:
        config.CACHE_DIR = previous


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile ``function`` into the kernels that call it."""
    return njit(nogil=True, error_model="numpy", forceinline=True, _nrt=False)(function)


class _Announcement(event.Listener):
    """Tells the user, once in a process, why the first call of a kernel takes a while: nothing if all were kept."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, event: event.Event) -> None:
        ours = event.data["dispatcher"].py_func.__module__.startswith("gsbench.")
        if ours and not self._said:
            self._said = True
            _logger.warning("compiling for this processor, some 10 s, once")

    def on_end(self, event: event.Event) -> None:
        pass


event.register("numba:compile", _Announcement())  # sent where the cache on disk has no machine code
