"""Digests of gsbench's own code, package by package, and which packages differ from the release.

A *package* is here a folder of gsbench or one of its files. If it is as released
(``released.json``), the versions of gsbench's stages stand for its code. Else a digest of its
syntax does. Loads no torch.
"""

import ast
import hashlib
import json
import platform
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path

import yaml

from gsbench.files import user_cache, write_json
from gsbench.parsing import DamagedError, SafeLoader, read_if_sound, read_json

PACKAGE = Path(__file__).resolve().parents[1]
RELEASED = "released.json"  # in gsbench's folder: the digests of all packages at the release
AS_RELEASED = "released"  # the state of a package that equals the release
DIGEST_CHARACTERS = 16
SYNTAX_DIGESTS = "syntax-1.json"  # another number if `syntax_of` changes
MAX_KEPT = 500  # digests in that file


def states_of(packages: Iterable[str]) -> dict[str, str]:
    """``{"eval": state}``: the state of each package, ``released`` or a digest of its syntax."""
    return {package: state_of(package) for package in sorted(set(packages))}


def edited(states: Mapping[str, str]) -> dict[str, str]:
    """The states of packages that differ from the release."""
    return {package: state for package, state in states.items() if state != AS_RELEASED}


def changed_since_asked(packages: Iterable[str]) -> list[str]:
    """The packages whose files have changed since this process first asked for their state."""
    return [package for package in packages if _contents(package) != _first_contents(package)]


@cache
def _first_contents(package: str) -> dict[str, bytes]:
    """The files of a package as they were when this process first asked for them."""
    return _contents(package)


@cache
def state_of(package: str) -> str:
    """The state of a package as this process first found it; see `states_of`."""
    released, contents = _released().get(package) or {}, _first_contents(package)
    # the usual case of an installed gsbench, without parsing
    if released.get("bytes") == (digest := _digest(contents)):
        return AS_RELEASED
    digest = _digest_of_syntax(contents, f"{platform.python_version()} {digest}")
    return AS_RELEASED if digest == released.get("syntax") else digest


def _digest_of_syntax(contents: Mapping[str, bytes], key: str) -> str:
    """The digest of the syntax of files, which the user's cache keeps by a ``key`` of them.

    Parsing all of gsbench takes a second.
    """
    file = user_cache("code") / SYNTAX_DIGESTS
    known = read_if_sound(file, dict[str, str]) or {}
    if key not in known:
        known[key] = _digest({name: syntax_of(content, name) for name, content in contents.items()})
        with suppress(OSError):  # only slower without
            file.parent.mkdir(parents=True, exist_ok=True)
            write_json(file, dict(list(known.items())[-MAX_KEPT:]))
    return known[key]


def _contents(package: str) -> dict[str, bytes]:
    """The content of a package's files by their paths below gsbench."""
    path = PACKAGE / package
    # a table of data beside the code determines numbers, too
    files = [path] if path.suffix else sorted([*path.rglob("*.py"), *path.rglob("*.yaml")])
    return {
        file.relative_to(PACKAGE).as_posix(): file.read_bytes() for file in files if file.is_file()
    }


def _digest(contents: Mapping[str, bytes]) -> str:
    parts = "".join(
        f"{hashlib.sha256(content).hexdigest()}  {name}\n"
        for name, content in sorted(contents.items())
    )
    return hashlib.sha256(parts.encode()).hexdigest()[:DIGEST_CHARACTERS]


@cache
def _released() -> dict[str, dict[str, str]]:
    try:
        released: dict[str, dict[str, str]] = read_json(PACKAGE / RELEASED)
    except (FileNotFoundError, DamagedError):
        return {}
    return released


def syntax_of(source: bytes, name: str = "") -> bytes:
    """A file's content without comments and docstrings, as text; its source if unparsable.

    A file whose ``name`` ends in .yaml is a table of data; any other is Python.
    """
    try:
        if name.endswith(".yaml"):  # the order of its entries may count, so they are not sorted
            return json.dumps(yaml.load(source, Loader=SafeLoader)).encode()
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError, yaml.YAMLError):
        return source
    for node in ast.walk(tree):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if ast.get_docstring(node, clean=False) is not None:
            node.body = node.body[1:]
    return ast.dump(tree).encode("utf-8", "surrogatepass")


def digests_at_release(package: str) -> dict[str, str]:
    """The digests of a package's files, and of their syntax, as `RELEASED` records them."""
    contents = _contents(package)
    syntax = {name: syntax_of(content, name) for name, content in contents.items()}
    return {"bytes": _digest(contents), "syntax": _digest(syntax)}
