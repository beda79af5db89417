"""Compilation of kernels by numba: options, the cache on disk, and the word to the user while something compiles."""

from __future__ import annotations

import ast
import functools
import hashlib
import logging
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from gsbench.system.machine import load_numba, numba_target

numba = load_numba()  # before anything of it is imported by name

from numba.core import event  # noqa: E402

PACKAGE = Path(__file__).resolve().parents[1]
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


def cache_folder(source: Path, package: Path = PACKAGE) -> Path:
    """The folder of the kernels of the file ``source``: another one for each state of what they are made of.

    numba looks at the file of a kernel, not at what that file imports, so a changed helper would leave stale machine
    code in use. The folder's name is a digest of all that the file imports of gsbench, constants included, and of the
    processor: numba tells processors apart in an index that two machines with one home folder may write at once.
    """
    digest = hashlib.sha256("\n".join((numba.__version__, *numba_target())).encode())
    for content in sorted(path.read_bytes() for path in import_closure(source, package)):
        digest.update(hashlib.sha256(content).digest())
    return cache_base() / digest.hexdigest()[:DIGEST_CHARACTERS]


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile ``function`` at its first call: without the GIL, without Python's division checks, cached on disk.

    Also without reference counts (``_nrt``), which numba would keep, atomically, at each inlined call: a kernel borrows
    all its arrays and may not allocate.
    """
    folder = cache_folder(Path(function.__code__.co_filename))
    previous = config.CACHE_DIR  # read when the decorator runs; other users of numba in this process keep theirs
    config.CACHE_DIR = str(folder)
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


def import_closure(source: Path, package: Path = PACKAGE) -> frozenset[Path]:
    """``source`` and every file of ``package`` that it imports, directly or through others.

    Read from the text, wherever the import stands: also inside functions, but not for types alone.
    """
    found: set[Path] = set()
    waiting = [source.resolve()]
    while waiting:
        path = waiting.pop()
        if path not in found:
            found.add(path)
            waiting += _imported(path, package.resolve())
    return frozenset(found)


@functools.cache
def _imported(source: Path, package: Path) -> tuple[Path, ...]:
    """The files of ``package`` that the text of ``source`` imports."""
    inner = source.relative_to(package).with_suffix("").parts
    is_package = source.name == "__init__.py"
    module = ".".join((package.name, *(inner[:-1] if is_package else inner)))
    files = []
    for imported, name in _names(ast.parse(source.read_bytes()), module, is_package):
        # A name is a module below, or else comes out of the module that is named.
        files.append((_file(f"{imported}.{name}", package) if name else None) or _file(imported, package))
    return tuple(file for file in files if file is not None)


def _file(module: str, package: Path) -> Path | None:
    """File of the module ``module`` of ``package``; None for modules of other packages."""
    first, *rest = module.split(".")
    if first != package.name:
        return None
    place = package.joinpath(*rest)
    for file in (place / "__init__.py", place.with_suffix(".py")):
        if file.is_file():
            return file
    return None


def _names(tree: ast.Module, module: str, is_package: bool) -> Iterator[tuple[str, str | None]]:
    """The modules that import statements name, each with what is taken of it, None for the module itself."""
    package = module if is_package else module.rpartition(".")[0]
    for node in _that_run(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            above = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
            source = ".".join(part for part in (above, node.module) if part)
            yield from ((source, alias.name) for alias in node.names)


def _that_run(node: ast.AST) -> Iterator[ast.AST]:
    """The nodes below ``node``, without the bodies of ``if TYPE_CHECKING``."""
    for child in ast.iter_child_nodes(node):
        if not (isinstance(child, ast.If) and isinstance(child.test, ast.Name) and child.test.id == "TYPE_CHECKING"):
            yield child
            yield from _that_run(child)
