"""State of gsbench's own code behind a result: a digest of each file that has a part in it. Loads no torch.

A file's digest is of its syntax: comments, docstrings and layout have no part in it. Where all files are as in a
release (``released.json``), the versions of the stages stand for them, which are bumped by hand.
"""

from __future__ import annotations

import ast
import hashlib
import logging
import os
import sys
import uuid
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from gsbench import IMPORTED_AT
from gsbench.files import write_json
from gsbench.parsing import DamagedError, read_json
from gsbench.system.imports import read_imports

PACKAGE = Path(__file__).resolve().parents[1]
RELEASED = "released.json"  # in the package: the digests of all files as they were released
AS_RELEASED = "released"  # the state of a file that is
DIGEST_CHARACTERS = 16
# Parts that make no number: what is said, how processes run, where files lie. What `config` and `settings` make of the
# user's words is in the keys as it is.
WITHOUT_NUMBERS = frozenset(
    """
    app cli config errors launch logs parsing records runs settings system tracking verbs words
    """.split()  # noqa: SIM905 - words are easier to read than a list of quoted ones
)
# Parts that work on results: none in a trial, unless a user's class asks for one. No stage's version stands for them.
ON_RESULTS = frozenset(("analysis", "bench", "claims", "datasets", "renders", "view"))
WITHOUT_PART = WITHOUT_NUMBERS | ON_RESULTS
# Modules that put a trial together: a part in each, and followed no further, since they know parts of every kind.
WIRING = tuple(f"pipeline/{name}.py" for name in ("components", "parts", "results", "trial", "wiring"))

DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
WITHOUT_MEANING = frozenset({"ctx", "kind", "type_comment"})  # fields of a tree that say nothing the rest does not

Names = tuple[tuple[str, str | None], ...]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Source:
    """A file of gsbench as it was when this process first asked: its digest, what it imports of gsbench."""

    stamp: list[int]
    digest: str
    names: Names
    loaded: bool  # whether this process had run it by then


_sources: dict[str, _Source] = {}  # by the path below the package
_unkept: set[str] = set()  # those whose digests no other process has left


def files_of(roots: Iterable[tuple[str, str | None]], asked: Iterable[tuple[str, str | None]] = ()) -> dict[str, str]:
    """``{"eval/ssim.py": state}`` for each file that the ``roots``, modules or names in them, reach by their imports.

    A name that a package only passes on counts as what defines it, so that an arm does not depend on its neighbours.
    ``asked`` are those that a user's class imports, which may be of parts that otherwise have none in a trial.
    The state is a digest, or ``released``.
    """
    found: dict[str, str] = {}
    waiting = [(root, False) for root in roots] + [(root, True) for root in asked]
    while waiting:
        name, is_asked = waiting.pop()
        file = _file(*name)
        if file is not None and file not in found and (_part(file) or (is_asked and _top(file) in ON_RESULTS)):
            found[file] = state_of(file)
            if file not in WIRING:
                waiting += [(imported, not _part(file)) for imported in _read(file).names]
    _keep_digests()
    return dict(sorted(found.items()))


def edited(files: Mapping[str, str]) -> dict[str, str]:
    """List the ``files`` that are not as released."""
    return {file: state for file, state in files.items() if state != AS_RELEASED}


def changed_files(recorded: Mapping[str, str]) -> list[str]:
    """List the files whose state is no longer the recorded one."""
    changed = [file for file, state in recorded.items() if state_of(file) != state]
    _keep_digests()
    return changed


def changed_while_running(files: Iterable[str], in_processes: bool) -> list[str]:
    """List the ``files`` that may have run in another state than was noted: they were edited and loaded later.

    With ``in_processes``, the work was done in processes of their own, which load all anew.
    """
    known = [(file, _sources[file]) for file in files if file in _sources]
    return [file for file, source in known if (in_processes or not source.loaded) and _stamp(file) != source.stamp]


def state_of(file: str) -> str:
    """The state of a file of gsbench: its digest, or ``released``; that of one that is gone is "gone"."""
    released = _released().get(file)
    try:
        digest = _read(file).digest
    except OSError:
        return AS_RELEASED if _released() and released is None else "gone"
    return AS_RELEASED if digest == released else digest


def digest_of(source: bytes) -> str:
    """The digest of a Python file's syntax, the same for every version of Python."""
    try:
        parts: list[str] = []
        _put(ast.parse(source), parts)
        source = "".join(parts).encode("utf-8", "surrogatepass")
    except (SyntaxError, ValueError, RecursionError):  # it cannot be run either
        pass
    return hashlib.sha256(source).hexdigest()[:DIGEST_CHARACTERS]


def _put(node: Any, parts: list[str]) -> None:
    """Add a tree as text; fields that are empty are left out, as newer versions of Python add such."""
    if isinstance(node, ast.AST):
        parts.append(f"{type(node).__name__}(")
        for name, value in ast.iter_fields(node):
            if name == "body" and isinstance(node, DOCUMENTED) and _is_text(value[0] if value else None):
                value = value[1:]
            if value is not None and value != [] and name not in WITHOUT_MEANING:
                parts.append(f"{name}=")
                _put(value, parts)
        parts.append(")")
    elif isinstance(node, list):
        parts.append("[")
        for item in node:
            _put(item, parts)
        parts.append("]")
    else:
        parts.append(f"{node!r},")


def _is_text(node: ast.AST | None) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _part(file: str) -> bool:
    return _top(file) not in WITHOUT_PART


def _top(file: str) -> str:
    """The part of gsbench that a file belongs to."""
    return file.partition("/")[0].removesuffix(".py")


def _module(file: str) -> str:
    return file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def _file(module: str, name: str | None) -> str | None:
    """The file below the package where ``name`` of ``module`` is defined, or that of the module."""
    head, _, below = module.partition(".")
    if head != PACKAGE.name:
        return None
    if name is not None and (inner := _place(f"{below}.{name}".lstrip("."))) is not None:
        return inner
    file = _place(below)
    if file is None or name is None or not file.endswith("__init__.py"):
        return file
    for source, taken in _read(file).names:
        if taken == name and source != module:
            return _file(source, name)
    return file


@cache
def _place(module: str) -> str | None:
    """The file of a module, by its name below the package."""
    for file in (f"{module.replace('.', '/')}.py", f"{module.replace('.', '/')}/__init__.py".lstrip("/")):
        if (PACKAGE / file).is_file():
            return file
    return None


def _object(path: Path) -> dict[str, Any]:
    """The object in a JSON file; empty where there is none, or none that can be read."""
    try:
        value = read_json(path)
    except (FileNotFoundError, DamagedError):
        return {}
    return value if isinstance(value, dict) else {}


@cache
def _released() -> dict[str, str]:
    return _object(PACKAGE / RELEASED)


def _read(file: str) -> _Source:
    """A file of gsbench as it was when this process first asked, which is what it runs. Raises OSError."""
    if file not in _sources:
        stamp, loaded = _stamp(file), f"{PACKAGE.name}.{_module(file)}" in sys.modules
        known = _digests().get(file)
        if known is None or known[0] != stamp:
            known = _digests()[file] = [stamp, *_parsed(file)]
            _unkept.add(file)
        digest = known[1]
        if loaded and stamp[1] > IMPORTED_AT:
            log.warning(
                "gsbench's %s was edited when it had been loaded: start again, else it is unknown what ran", file
            )
            digest = uuid.uuid4().hex[:DIGEST_CHARACTERS]
        names = tuple((module, name) for module, name in known[2])
        _sources[file] = _Source(stamp, digest, names, loaded)
    return _sources[file]


def _parsed(file: str) -> tuple[str, list[list[str | None]]]:
    """The digest of a file, and what it imports of gsbench."""
    content = (PACKAGE / file).read_bytes()
    try:
        name = f"{PACKAGE.name}.{_module(file)}".removesuffix(".__init__")
        names = read_imports(ast.parse(content), name, file.endswith("__init__.py")).names
    except (SyntaxError, ValueError, RecursionError):
        names = ()
    own = [[module, taken] for module, taken in names if module.partition(".")[0] == PACKAGE.name]
    return digest_of(content), own


def _stamp(file: str) -> list[int]:
    """Mark that changes whenever a file does; empty where it is gone."""
    try:
        found = os.stat(PACKAGE / file)
    except FileNotFoundError:
        return []
    return [found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino]


@cache
def _digests() -> dict[str, list[Any]]:
    """Digests and imports of files by the state in which they had them, as other processes have left them on disk."""
    kept = _object(_cache_file())
    files = kept.get("files")
    if kept.get("read_by") != _read_by() or not isinstance(files, dict):
        return {}
    return {file: entry for file, entry in files.items() if isinstance(entry, list) and len(entry) == 3}


def _keep_digests() -> None:
    """Leave the digests to other processes, where that is allowed."""
    if _unkept:
        with suppress(OSError):
            _cache_file().parent.mkdir(parents=True, exist_ok=True)
            write_json(_cache_file(), {"read_by": _read_by(), "files": _digests()})
    _unkept.clear()


def _read_by() -> list[Any]:
    """State of Python and of the code that find digests and imports."""
    return [sys.version, _stamp("runs/code.py"), _stamp("system/imports.py")]


def _cache_file() -> Path:
    """In the user's cache, one for each place where gsbench lies."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(home, "gsbench", f"code-{hashlib.sha256(str(PACKAGE).encode()).hexdigest()[:DIGEST_CHARACTERS]}.json")


def main() -> None:
    """Write the digests of all files as those of a release (docs/releasing.md)."""
    files = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))
    digests = {file: digest_of((PACKAGE / file).read_bytes()) for file in files if _part(file)}
    write_json(PACKAGE / RELEASED, digests)


if __name__ == "__main__":
    main()
