"""Compilation of kernels by numba: options, the cache on disk, and a message to the user.

Of all processes that use a cache, one compiles a kernel; the others wait and load it.
"""

import functools
import hashlib
import logging
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gsbench.files import user_cache
from gsbench.system.locks import hold
from gsbench.system.machine import load_numba, numba_target
from gsbench.system.resources import CLOCK

numba = load_numba()  # first: it protects the import of numba

from numba.core import event  # noqa: E402

PACKAGE = Path(__file__).resolve().parents[1]
# Files and folders with the functions and constants of kernels. A test compares them with the
# imports.
SOURCES = (
    "raster/cpu",
    "raster/base.py",
    "raster/formulas.py",
    "raster/staged.py",
    "gaussians/model.py",
    "gaussians/paper_values.py",
    "eval/ssim.py",
    "train/loss_cpu.py",
    "scene/courtyard",
    "system/jit.py",
)
DIGEST_CHARACTERS = 16
TEMPORARY_PREFIX = "gsbench-numba-"  # of the temporary folder, if no other folder is writable

njit: Any = numba.njit
config: Any = numba.config

_logger = logging.getLogger(__name__)


@functools.cache
def cache_base() -> Path:
    """The folder for caches of compiled kernels: ``NUMBA_CACHE_DIR``, else one in the user's cache.

    If neither is writable, it is a private temporary folder, and the next process compiles again.
    """
    configured = os.environ.get("NUMBA_CACHE_DIR")
    for base in [*([Path(configured)] if configured else []), user_cache("numba")]:
        try:
            base.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(base, os.W_OK):
            return base
    return Path(tempfile.mkdtemp(prefix=TEMPORARY_PREFIX))


@functools.cache
def cache_folder(package: Path = PACKAGE) -> Path:
    """The folder of compiled kernels, a different one for each state of their sources.

    numba checks the file of a kernel, but not the files that it imports, so after a change of a
    helper it would use outdated machine code. The name of the folder is a digest of all `SOURCES`
    and of the processor. numba itself separates processors only in an index file, which two
    machines with a common home folder could write at once.
    """
    digest = hashlib.sha256("\n".join((numba.__version__, *numba_target())).encode())
    for source in SOURCES:
        root = package / source
        for path in sorted(root.rglob("*.py")) if root.is_dir() else [root]:
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return cache_base() / digest.hexdigest()[:DIGEST_CHARACTERS]


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile ``function`` at its first call, or earlier by ``compile(signature)``.

    The kernel runs without the GIL and without Python's division checks, and is cached on disk.
    Reference counts are off, too (``_nrt``): numba would update them atomically at each inlined
    call. So a kernel must not allocate memory; the caller owns all arrays.
    """
    # The decorator reads this setting. Other users of numba in this process keep their own.
    previous = config.CACHE_DIR
    config.CACHE_DIR = str(cache_folder())
    try:
        dispatcher = njit(nogil=True, cache=True, error_model="numpy", _nrt=False)(function)
    finally:
        config.CACHE_DIR = previous
    compile_now = dispatcher.compile  # numba, too, calls this method, at the first call

    def compile_in_turn(signature: Any) -> Any:
        with _turn():
            return compile_now(signature)

    dispatcher.compile = compile_in_turn
    return dispatcher


_one_thread = threading.Lock()


@contextmanager
def _turn() -> Iterator[None]:
    """Hold the cache, so that no other process compiles the same kernel; the time is counted."""
    with _one_thread:
        started = time.perf_counter()
        try:
            folder = cache_folder()
            folder.mkdir(parents=True, exist_ok=True)
            with hold(folder / "compiling.lock", "the compilation of kernels"):
                yield
        finally:
            CLOCK.seconds += time.perf_counter() - started


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile ``function`` into the kernels that call it; Python itself cannot call it."""
    return njit(
        nogil=True,
        error_model="numpy",
        forceinline=True,
        no_cpython_wrapper=True,  # without the two ways in from outside, kernels compile faster
        no_cfunc_wrapper=True,
        _nrt=False,
    )(function)


class _Announcement(event.Listener):
    """Tells the user once per process that kernels are compiled, unless all are in the cache."""

    def __init__(self) -> None:
        self._announced = False

    def on_start(self, event: event.Event) -> None:
        ours = event.data["dispatcher"].py_func.__module__.startswith("gsbench.")
        if ours and not self._announced:
            self._announced = True
            _logger.warning("compiling kernels for this processor, some 30 s, once")

    def on_end(self, event: event.Event) -> None:
        pass


# the event means that the cache had no machine code
event.register("numba:compile", _Announcement())
