"""The code that made a result: gsbench's own by *rooms* (parts of the package), the user's by modules. Loads no torch.

If a room is as released (``released.json``), the versions of gsbench's stages, which are bumped by hand, stand for it.
In a checkout that differs, the key of a stage also contains the digests of the differing rooms that it uses. A user's
modules are hashed whole: those of configured classes and those in ``allow_targets``, since no others can be imported.
"""

import ast
import hashlib
import importlib.util
import sys
import sysconfig
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import cache
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

from gsbench.files import write_json
from gsbench.parsing import DamagedError, read_json

OWN = "gsbench."  # prefix of the import paths of gsbench's own classes
SHOWN = 8  # characters of a digest in messages
PACKAGE = Path(__file__).resolve().parents[1]
RELEASED = "released.json"  # in the package: the digests of all rooms at the release
AS_RELEASED = "released"  # the state of a room that equals the release
DIGEST_CHARACTERS = 16

# The rooms of each stage: folders and files of gsbench that determine its numbers. Code that only reports, shows,
# launches or reads is no room. Nor is code that makes objects from settings: keys contain the settings themselves.
# An edit of one densifier changes the room of all densifiers; in return, the table is simple enough to check.
MODEL = ("scene", "gaussians", "densify", "raster", "train", "events.py")
LOSS = ("eval/ssim.py", "eval/images.py", "eval/pictures.py")
ROOMS = {
    "scene": ("scene", "init", "pipeline/steps/scene.py"),
    "init": ("scene", "init", "gaussians", "weights.py", "pipeline/steps/scene.py"),
    "train": (*MODEL, *LOSS, "external", "pipeline/steps/train.py"),
    "ground_truth": ("scene", "pipeline/steps/scene.py"),
    "evaluate": (*MODEL, "eval", "weights.py", "pipeline/steps"),
}
VIEWS_ROOMS = ("scene",)  # rooms of the prepared photographs beside the store

INSTALLED = frozenset({"site-packages", "dist-packages"})  # the version stands for a package in these folders
CODE_SUFFIXES = frozenset({".py", ".so", ".pyd", ".c", ".cpp", ".cu", ".h", ".cuh"})

# ---- gsbench's own code


def states_of(rooms: Iterable[str]) -> dict[str, str]:
    """``{"eval": state}``: the state of each room, ``released`` or else a digest of its syntax."""
    return {room: _state(room) for room in sorted(set(rooms))}


def edited(states: Mapping[str, str]) -> dict[str, str]:
    """The states of rooms that differ from the release."""
    return {room: state for room, state in states.items() if state != AS_RELEASED}


def changed_rooms(recorded: Mapping[str, str]) -> list[str]:
    """The rooms whose state differs from the recorded one."""
    return [room for room, state in recorded.items() if _state(room) != state]


def changed_since_asked(rooms: Iterable[str]) -> list[str]:
    """The rooms whose files have changed since this process first asked for their state."""
    return [room for room in rooms if _contents(room) != _first_contents(room)]


@cache
def _first_contents(room: str) -> dict[str, bytes]:
    """The files of a room when this process first asked for them: later edits do not change what it runs."""
    return _contents(room)


@cache
def _state(room: str) -> str:
    released, contents = _released().get(room) or {}, _first_contents(room)
    if released.get("bytes") == _digest(contents):  # the usual case of an installed gsbench, without parsing
        return AS_RELEASED
    digest = _digest({name: syntax_of(content) for name, content in contents.items()})
    return AS_RELEASED if digest == released.get("syntax") else digest


def _contents(room: str) -> dict[str, bytes]:
    """The content of a room's files by their paths below the package."""
    path = PACKAGE / room
    files = [path] if path.suffix else sorted(path.rglob("*.py"))
    return {file.relative_to(PACKAGE).as_posix(): file.read_bytes() for file in files if file.is_file()}


def _digest(contents: Mapping[str, bytes]) -> str:
    parts = "".join(f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name, content in sorted(contents.items()))
    return hashlib.sha256(parts.encode()).hexdigest()[:DIGEST_CHARACTERS]


@cache
def _released() -> dict[str, dict[str, str]]:
    try:
        released: dict[str, dict[str, str]] = read_json(PACKAGE / RELEASED)
    except (FileNotFoundError, DamagedError):
        return {}
    return released


def syntax_of(source: bytes) -> bytes:
    """The syntax tree of a Python file without docstrings, as text; the source itself if it cannot be parsed."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError):
        return source
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and _is_text(body):
            node.body = node.body[1:]
    return ast.dump(tree).encode("utf-8", "surrogatepass")


def _is_text(body: Any) -> bool:
    first = body[0] if body else None
    return isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str)


def main() -> None:
    """Write ``released.json`` with the digests of all rooms (docs/releasing.md)."""
    digests = {}
    for room in sorted({room for rooms in ROOMS.values() for room in rooms}):
        contents = _contents(room)
        syntax = {name: syntax_of(content) for name, content in contents.items()}
        digests[room] = {"bytes": _digest(contents), "syntax": _digest(syntax)}
    write_json(PACKAGE / RELEASED, digests)


# ---- the user's code

_digests_at_import: dict[str, tuple[ModuleSpec, str | None]] = {}  # a module's digest when it was first asked for


def user_modules(values: Mapping[str, Any]) -> dict[str, str]:
    """``{module: sha256}`` of the user's code behind a configuration; {} if all of its classes are gsbench's.

    These are the modules of its classes, and the modules in ``allow_targets``, which the classes may import. An
    installed module is included only if a class comes from it.
    """
    of_classes = {target.split(".")[0] for target in _targets(values) if not target.startswith(OWN)}
    if not of_classes:
        return {}
    helpers = {name.split(".")[0] for name in values.get("allow_targets") or ()} - of_classes
    helpers = {name for name in helpers if (spec := _find_spec(name)) is not None and not _is_installed(spec)}
    digests = {name: module_digest(name) for name in sorted(of_classes | helpers)}
    return {name: digest for name, digest in digests.items() if digest is not None}


def module_digest(name: str, folder: str | None = None) -> str | None:
    """The sha256 of a top-level module: of its file, or of all code in its package. None if it is not found.

    A module that this process has imported keeps its digest: that is the code that runs. With ``folder``, the module is
    found as by a program that is started there, without regard to what this process has imported.
    """
    loaded = sys.modules.get(name) if folder is None else None
    spec = _find_spec(name, folder) if loaded is None else loaded.__spec__
    if spec is None:
        return None
    if loaded is None:
        return _digest_on_disk(spec)
    cached = _digests_at_import.get(name)
    if cached is None or cached[0] is not spec:
        cached = _digests_at_import[name] = (spec, _digest_on_disk(spec))
    return cached[1]


def has_changed_since_import(name: str) -> bool:
    """Return whether a module's files differ from the code that this process has imported and runs."""
    loaded = sys.modules.get(name)
    spec = None if loaded is None else loaded.__spec__
    return spec is not None and module_digest(name) != _digest_on_disk(spec)


def unnamed_modules(before: Collection[str], named: Collection[str]) -> list[str]:
    """The user's modules that were imported since ``before`` but are not ``named``: their edits change no key."""
    tops = {name.split(".")[0] for name in sys.modules.keys() - set(before)} - {*named, PACKAGE.name}
    specs = {top: getattr(sys.modules.get(top), "__spec__", None) for top in tops}
    return sorted(top for top, spec in specs.items() if spec is not None and not _is_installed(spec))


def _targets(values: Any) -> Iterator[str]:
    """The import paths (``_target_``) in a configuration, at any depth."""
    if isinstance(values, Mapping):
        if isinstance(values.get("_target_"), str):
            yield values["_target_"]
        for value in values.values():
            yield from _targets(value)
    elif isinstance(values, list | tuple):
        for value in values:
            yield from _targets(value)


def _find_spec(name: str, folder: str | None = None) -> ModuleSpec | None:
    """A top-level module as Python would find it, without importing it."""
    importlib.invalidate_caches()  # a finder caches the content of folders, and files may be newer
    try:
        if folder is not None:
            return PathFinder.find_spec(name, [*sys.path, folder])
        return importlib.util.find_spec(name) if name else None
    except (ImportError, ValueError):
        return None


def _digest_on_disk(spec: ModuleSpec) -> str | None:
    """The sha256 of a module's code: of its content if it is one file, else of the list of its files' hashes."""
    folders = [Path(place) for place in spec.submodule_search_locations or ()]
    if not folders:
        file = Path(spec.origin or "")
        return hashlib.sha256(file.read_bytes()).hexdigest() if spec.has_location and file.is_file() else None
    parts = [
        f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.relative_to(folder).as_posix()}\n"
        for folder in folders
        for file in sorted(folder.rglob("*"))
        if file.suffix in CODE_SUFFIXES and file.is_file()
    ]
    return hashlib.sha256("".join(parts).encode()).hexdigest() if parts else None


def _is_installed(spec: ModuleSpec) -> bool:
    """Return whether a module is Python's own or of an installed package: their versions stand for them."""
    paths = [spec.origin] if spec.has_location else list(spec.submodule_search_locations or [])
    library = [sysconfig.get_path(key) for key in ("stdlib", "platstdlib")]
    return all(
        path is None or INSTALLED & set(Path(path).parts) or any(Path(path).is_relative_to(one) for one in library)
        for path in paths
    )


if __name__ == "__main__":
    main()
