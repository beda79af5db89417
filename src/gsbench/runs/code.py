"""The code that made a result: gsbench's own by rooms, the user's by modules. Loads no torch.

Where gsbench is as in a release (``released.json``), the versions of its stages stand for it, which are bumped by hand.
In a checkout that differs, the key of a stage has the digests of the rooms that it uses as well. A user's modules are
hashed whole: those that ``allow_targets`` names, since nothing else of the user's can be imported.
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

OWN = "gsbench."  # how the import paths of gsbench's own classes start
SHOWN = 8  # characters of a digest that people see
PACKAGE = Path(__file__).resolve().parents[1]
RELEASED = "released.json"  # in the package: the digests of all rooms as they were released
AS_RELEASED = "released"  # the state of a room that is
DIGEST_CHARACTERS = 16

# Folders and files of gsbench that make the numbers of each stage. What only says, shows, launches or reads has no
# part, nor what makes objects of the settings, which are in the keys as they are. An edit of one densifier changes the
# room of all: the price of a table that anybody can check.
MODEL = ("scene", "gaussians", "densify", "raster", "train", "events.py")
LOSS = ("eval/ssim.py", "eval/images.py", "eval/pictures.py")
ROOMS = {
    "scene": ("scene", "init", "pipeline/steps/scene.py"),
    "init": ("scene", "init", "gaussians", "weights.py", "pipeline/steps/init.py"),
    "train": (*MODEL, *LOSS, "external", "pipeline/steps/train.py", "pipeline/steps/external.py"),
    "ground_truth": ("scene", "pipeline/steps/scene.py"),
    "evaluate": (*MODEL, "eval", "weights.py", "pipeline/steps"),
}
VIEWS_ROOMS = ("scene",)  # of the prepared photographs beside the store

INSTALLED = frozenset({"site-packages", "dist-packages"})  # folders of packages that are known by their versions
CODE_SUFFIXES = frozenset({".py", ".so", ".pyd", ".c", ".cpp", ".cu", ".h", ".cuh"})

# ---- gsbench's own code


def states_of(rooms: Iterable[str]) -> dict[str, str]:
    """``{"eval": state}``: the state of each room, which is a digest of its syntax, or ``released``."""
    return {room: _state(room) for room in sorted(set(rooms))}


def edited(states: Mapping[str, str]) -> dict[str, str]:
    """The rooms among ``states`` that are not as released."""
    return {room: state for room, state in states.items() if state != AS_RELEASED}


def changed_rooms(recorded: Mapping[str, str]) -> list[str]:
    """The rooms whose state is no longer the recorded one."""
    return [room for room, state in recorded.items() if _state(room) != state]


def changed_since_asked(rooms: Iterable[str]) -> list[str]:
    """The rooms whose files are other ones than when their state was first asked for."""
    return [room for room in rooms if _contents(room) != _noted(room)]


@cache
def _noted(room: str) -> dict[str, bytes]:
    """The files of a room as they were when this process first asked."""
    return _contents(room)


@cache
def _state(room: str) -> str:
    released, noted = _released().get(room) or {}, _noted(room)
    if released.get("bytes") == _digest(noted):  # as nearly always where gsbench is installed: nothing is parsed
        return AS_RELEASED
    digest = _digest({name: syntax_of(content) for name, content in noted.items()})
    return AS_RELEASED if digest == released.get("syntax") else digest


def _contents(room: str) -> dict[str, bytes]:
    """The files of a room by their paths below the package."""
    place = PACKAGE / room
    files = [place] if place.suffix else sorted(place.rglob("*.py"))
    return {file.relative_to(PACKAGE).as_posix(): file.read_bytes() for file in files if file.is_file()}


def _digest(contents: Mapping[str, bytes]) -> str:
    parts = "".join(f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name, content in sorted(contents.items()))
    return hashlib.sha256(parts.encode()).hexdigest()[:DIGEST_CHARACTERS]


@cache
def _released() -> dict[str, dict[str, str]]:
    try:
        found: dict[str, dict[str, str]] = read_json(PACKAGE / RELEASED)
    except (FileNotFoundError, DamagedError):
        return {}
    return found


def syntax_of(source: bytes) -> bytes:
    """A Python file without comments, docstrings and layout; a file that is not Python as it is."""
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
    """Write the digests of all rooms as those of a release (docs/releasing.md)."""
    found = {}
    for room in sorted({room for rooms in ROOMS.values() for room in rooms}):
        contents = _contents(room)
        syntax = {name: syntax_of(content) for name, content in contents.items()}
        found[room] = {"bytes": _digest(contents), "syntax": _digest(syntax)}
    write_json(PACKAGE / RELEASED, found)


# ---- the user's code

_as_imported: dict[str, tuple[ModuleSpec, str | None]] = {}  # what a module's files held when it was imported


def user_modules(values: Mapping[str, Any]) -> dict[str, str]:
    """``{module: sha256}`` of the user's code behind a configuration: empty where all of its classes are gsbench's.

    That are the modules of its classes, and all that ``allow_targets`` names: one may import the other. What is
    installed counts where a class is from it; else its version stands for it.
    """
    named = {target.split(".")[0] for target in _targets(values) if not target.startswith(OWN)}
    if not named:
        return {}
    helpers = {name.split(".")[0] for name in values.get("allow_targets") or ()} - named
    helpers = {name for name in helpers if (spec := _find(name)) is not None and not _is_installed(spec)}
    digests = {name: module_digest(name) for name in sorted(named | helpers)}
    return {name: digest for name, digest in digests.items() if digest is not None}


def module_digest(name: str, folder: str | None = None) -> str | None:
    """The sha256 of a top-level module: of its file, or of all code in its package. None where it is not found.

    One that this process has imported counts as it was then: that is the code that runs. With ``folder``, it is looked
    for as a program started there would find it, whatever this process has imported.
    """
    loaded = sys.modules.get(name) if folder is None else None
    spec = _find(name, folder) if loaded is None else loaded.__spec__
    if spec is None:
        return None
    if loaded is None:
        return _digest_on_disk(spec)
    known = _as_imported.get(name)
    if known is None or known[0] is not spec:
        known = _as_imported[name] = (spec, _digest_on_disk(spec))
    return known[1]


def has_changed_since_import(name: str) -> bool:
    """Return whether a module's files are no longer those that this process has imported, and therefore runs."""
    loaded = sys.modules.get(name)
    spec = None if loaded is None else loaded.__spec__
    return spec is not None and module_digest(name) != _digest_on_disk(spec)


def unnamed_modules(before: Collection[str], named: Collection[str]) -> list[str]:
    """The user's modules that were imported since ``before`` and are not ``named``: an edit there goes unnoticed."""
    tops = {name.split(".")[0] for name in sys.modules.keys() - set(before)} - {*named, PACKAGE.name}
    specs = {top: getattr(sys.modules.get(top), "__spec__", None) for top in tops}
    return sorted(top for top, spec in specs.items() if spec is not None and not _is_installed(spec))


def _targets(values: Any) -> Iterator[str]:
    """The import paths of classes in a configuration, at any depth."""
    if isinstance(values, Mapping):
        if isinstance(values.get("_target_"), str):
            yield values["_target_"]
        for value in values.values():
            yield from _targets(value)
    elif isinstance(values, list | tuple):
        for value in values:
            yield from _targets(value)


def _find(name: str, folder: str | None = None) -> ModuleSpec | None:
    """A top-level module, as Python would find it; imports nothing."""
    importlib.invalidate_caches()  # the files may be younger than what a finder remembers of their folder
    try:
        if folder is not None:
            return PathFinder.find_spec(name, [*sys.path, folder])
        return importlib.util.find_spec(name) if name else None
    except (ImportError, ValueError):
        return None


def _digest_on_disk(spec: ModuleSpec) -> str | None:
    """One hash of the code of a module: of one file the sha256 of what it holds, of several that of their list."""
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
    """Return whether a module is Python's own or of an installed package, which its version stands for."""
    places = [spec.origin] if spec.has_location else list(spec.submodule_search_locations or [])
    library = [sysconfig.get_path(key) for key in ("stdlib", "platstdlib")]
    return all(
        place is None or INSTALLED & set(Path(place).parts) or any(Path(place).is_relative_to(one) for one in library)
        for place in places
    )


if __name__ == "__main__":
    main()
