"""Hashes of what makes a result: of a configuration, of each step (its key), and of the code.

A step is a stage with its inputs. Its key is known before it runs. This module loads neither Hydra
nor torch.

gsbench's own code is identified by *rooms* (parts of the package). If a room is as released
(``released.json``), the versions of gsbench's stages, which are bumped by hand, stand for it. In a
checkout that differs, the key of a stage also contains the digests of the differing rooms that it
uses. A user's modules are hashed whole: those of configured classes and those in ``allow_targets``,
since no others can be imported.
"""

import ast
import hashlib
import importlib.util
import json
import os
import sys
import sysconfig
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, is_dataclass
from functools import cache, cached_property
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.files import file_sha256
from gsbench.parsing import DamagedError, read_json
from gsbench.settings import option_fields

TARGET = "_target_"  # the key of a class's import path
OWN = "gsbench."  # prefix of the import paths of gsbench's own classes
# Options that cannot change a result. This holds for gsbench's own classes; a user's class may use
# the names otherwise.
WITHOUT_EFFECT = ("threads", "weights", "download", "time_limit_minutes")
# Settings that only declare how results are read or what an ablation may turn off.
# train.steps_scaler has been applied to the steps.
DECLARED = {"eval": ("primary", "controls"), "densify": ("switches",), "train": ("steps_scaler",)}
NOT_HASHED = ("name", "seed", "device", "threads", "runs", "allow_targets", "tracking", "launch")


def is_hashed(key: str) -> bool:
    """Return whether the setting of a dotted key, or its group, counts in the configuration's hash.

    `determining_settings` then leaves out some settings within groups.
    """
    return key.partition(".")[0] not in NOT_HASHED


def config_hash(values: dict[str, Any]) -> str:
    """sha256 of the settings and the user's code that determine a result, without the seed.

    Names, devices, folders, tracking and launchers do not change it.
    """
    modules = user_modules(values)
    return sha256_of(determining_settings(values) | ({"code": modules} if modules else {}))


def determining_settings(values: Mapping[str, Any]) -> dict[str, Any]:
    """The settings among ``values`` that determine a result, without the seed."""
    kept = {key: value for key, value in values.items() if is_hashed(key)}
    for key, group in kept.items():
        if isinstance(group, dict):
            dropped = set(DECLARED.get(key, ()))
            if str(group.get("_target_") or OWN).startswith(OWN):
                dropped |= set(WITHOUT_EFFECT)
            kept[key] = {name: value for name, value in group.items() if name not in dropped}
    return kept


def sha256_of(values: Any) -> str:
    """sha256 of canonical JSON: sorted keys, no spaces, floats by repr."""
    return hashlib.sha256(
        json.dumps(values, sort_keys=True, separators=(",", ":")).encode()
    ).hexdigest()


def flatten(mapping: Mapping[str, Any], keep_empty: bool = False) -> dict[str, Any]:
    """Nested mappings as one mapping with dotted keys; ``keep_empty`` keeps empty mappings.

    Examples:
        >>> flatten({"a": {"b": 1, "c": {}}, "d": [2]})
        {'a.b': 1, 'd': [2]}
    """
    flat: dict[str, Any] = {}
    for key, value in mapping.items():
        if isinstance(value, Mapping) and (value or not keep_empty):
            flat |= {f"{key}.{name}": inner for name, inner in flatten(value, keep_empty).items()}
        else:
            flat[str(key)] = value
    return flat


# ---- stages and steps


@dataclass(frozen=True)
class Stage:
    """A stage of the pipeline, such as training.

    ``version`` is bumped by hand when the stage's code computes something else. ``resumable``
    stages continue from the files of a killed build; the others start in an empty folder. Files
    that match ``scratch`` are needed only by the build, and removed when the result is
    complete.
    """

    name: str
    version: int
    resumable: bool = False
    scratch: tuple[str, ...] = ()

    def key(self, inputs: dict[str, Any]) -> str:
        """sha256 of the stage's name, its version and all inputs, which include upstream keys."""
        return sha256_of({"stage": self.name, "version": self.version, "inputs": inputs})


@dataclass(frozen=True)
class Step:
    """One step of a trial: ``build(folder)`` computes the result that ``inputs`` determine.

    ``code`` has the states of the rooms that it uses (`ROOMS`). ``check`` is called after building;
    it raises if other code than that in ``inputs`` may have built the result.
    """

    stage: Stage
    inputs: dict[str, Any]
    build: Callable[[Path], None] = field(repr=False)
    code: Mapping[str, str] = field(default_factory=dict, repr=False)
    check: Callable[[], None] = field(default=lambda: None, repr=False)

    @cached_property
    def key(self) -> str:
        """The key under which the step's result is stored."""
        return self.stage.key(self.inputs)


# (name, version). Bump the version when the stage's code computes something else.
CAPTURE = Stage("scene", 1)
INIT = Stage("init", 3, resumable=True)
TRAIN = Stage("train", 2, resumable=True, scratch=("checkpoint-*.pt",))
GROUND_TRUTH = Stage("ground_truth", 1)
EVALUATE = Stage("evaluate", 2)

STAGES = (CAPTURE, INIT, TRAIN, GROUND_TRUTH, EVALUATE)


# ---- the inputs of a step: options of components, gsbench's code and the user's code


@dataclass(frozen=True)
class UserCode:
    """The user's code in a trial: digests of its modules, and the classes that are configured.

    ``targets`` maps a place of the configuration (``densify``, ``eval.extra.sharp``) to a class's
    import path, gsbench's own classes included.
    """

    modules: Mapping[str, str] = field(default_factory=dict)
    targets: Mapping[str, str] = field(default_factory=dict)

    def is_behind(self, component: Any, place: str) -> bool:
        """Return whether the component's class comes from a user's module, or is named by one."""
        defined_in = f"{type(component).__module__}."
        return not (self.targets.get(place, OWN).startswith(OWN) and defined_in.startswith(OWN))


NO_USER_CODE = UserCode()


def options_of(
    group: str, component: Any, user: UserCode = NO_USER_CODE, place: str | None = None
) -> dict[str, Any]:
    """The class and options of a component of ``group``, as they enter a stage's key.

    For gsbench's own classes, options that cannot change a result are left out. For a user's class,
    the digests of the user's modules are added. ``place`` is where the configuration names the
    class, if that is not the group.
    """
    cls, is_users = type(component), user.is_behind(component, place or group)
    values: dict[str, Any] = {"class": f"{cls.__module__}.{cls.__qualname__}"}
    if is_users:
        values["source"] = dict(user.modules)
    if is_dataclass(component):
        left_out = () if is_users else WITHOUT_EFFECT
        options = {
            one.name: getattr(component, one.name)
            for one in option_fields(cls)
            if one.name not in left_out
        }
        values |= json.loads(json.dumps(options, default=str))
    return values


def rasterizer_inputs(rasterizer: Any, user: UserCode = NO_USER_CODE) -> str | dict[str, Any]:
    """The rasterizer in a stage's key: gsbench's own by name, others by class, code and options."""
    name: str = rasterizer.name
    return (
        {"name": name} | options_of("raster", rasterizer, user)
        if user.is_behind(rasterizer, "raster")
        else name
    )


def step_of(
    stage: Stage,
    inputs: dict[str, Any],
    build: Callable[[Path], None],
    user: UserCode = NO_USER_CODE,
    in_processes: bool = False,
) -> Step:
    """The step of ``stage`` with ``inputs``, which ``build`` computes.

    If parts of gsbench's source behind it differ from the release, their states are added to
    the inputs. ``in_processes`` says that the build starts processes, which import the code
    anew.
    """
    rooms = ROOMS[stage.name]
    states = states_of(rooms)

    def check() -> None:
        changed = [f"gsbench's {room}" for room in changed_since_asked(rooms)]
        changed += [
            f"the code of {name}" for name in user.modules if has_changed_since_import(name)
        ]
        if changed:
            raise InputError(
                f"{', '.join(changed)} changed while {stage.name} ran, so it may have used the old "
                "and the new code: start again"
            )

    if edited_rooms := edited(states):
        inputs = inputs | {"code": edited_rooms}
    # This process keeps running the code that it imported. Processes that a build starts import the
    # files as they are then, so only for these an edit during the build matters.
    return (
        Step(stage, inputs, build, states, check)
        if in_processes
        else Step(stage, inputs, build, states)
    )


# ---- gsbench's own code

SHOWN = 8  # characters of a digest in messages
PACKAGE = Path(__file__).resolve().parents[1]
RELEASED = "released.json"  # in the package: the digests of all rooms at the release
AS_RELEASED = "released"  # the state of a room that equals the release
DIGEST_CHARACTERS = 16

# The rooms of each stage: folders and files of gsbench that determine its numbers. Code that cannot
# change a number is not listed. Nor is code that makes objects from settings: keys
# contain the settings themselves. An edit of one densifier changes the room of all densifiers; in
# return, the table is simple enough to check.
MODEL = ("scene", "gaussians", "densify", "raster", "train", "events.py", "normalization.py")
LOSS = ("eval/ssim.py", "eval/images.py", "eval/pictures.py")
ROOMS = {
    "scene": ("scene", "init", "normalization.py", "pipeline/steps/scene.py"),
    "init": (
        "scene",
        "init",
        "gaussians",
        "normalization.py",
        "weights.py",
        "pipeline/steps/scene.py",
    ),
    "train": (*MODEL, *LOSS, "external", "pipeline/steps/train.py"),
    "ground_truth": ("scene", "normalization.py", "pipeline/steps/scene.py"),
    "evaluate": (*MODEL, "eval", "weights.py", "pipeline/steps"),
}
VIEWS_ROOMS = ("scene",)  # rooms of the prepared photographs beside the store


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
    """The files of a room as they were when this process first asked for them."""
    return _contents(room)


@cache
def _state(room: str) -> str:
    released, contents = _released().get(room) or {}, _first_contents(room)
    # the usual case of an installed gsbench, without parsing
    if released.get("bytes") == _digest(contents):
        return AS_RELEASED
    digest = _digest({name: syntax_of(content) for name, content in contents.items()})
    return AS_RELEASED if digest == released.get("syntax") else digest


def _contents(room: str) -> dict[str, bytes]:
    """The content of a room's files by their paths below the package."""
    path = PACKAGE / room
    files = [path] if path.suffix else sorted(path.rglob("*.py"))
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


def syntax_of(source: bytes) -> bytes:
    """A Python file's syntax tree without docstrings, as text; its source if unparsable."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError, RecursionError):
        return source
    for node in ast.walk(tree):
        if not isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if ast.get_docstring(node, clean=False) is not None:
            node.body = node.body[1:]
    return ast.dump(tree).encode("utf-8", "surrogatepass")


def room_digests(room: str) -> dict[str, str]:
    """The digests of a room's files, and of their syntax, as `RELEASED` records them."""
    contents = _contents(room)
    syntax = {name: syntax_of(content) for name, content in contents.items()}
    return {"bytes": _digest(contents), "syntax": _digest(syntax)}


# ---- the user's code

# packages in these folders are identified by their versions
INSTALLED = frozenset({"site-packages", "dist-packages"})
CODE_SUFFIXES = frozenset({".py", ".so", ".pyd", ".c", ".cpp", ".cu", ".h", ".cuh"})

# a module's digest when it was first asked for
_digests_at_import: dict[str, tuple[ModuleSpec, str | None]] = {}


def user_modules(values: Mapping[str, Any]) -> dict[str, str]:
    """``{module: sha256}`` of the user's code behind a configuration; {} if there is none.

    These are the modules of its classes, without trackers, and the modules in ``allow_targets``,
    which the classes may import. An installed module is included only if a class comes from it.
    """
    named = [(place[0], name.split(".")[0]) for place, name in targets_in(values) if place]
    named = [(group, module) for group, module in named if f"{module}." != OWN]
    of_classes = {module for group, module in named if is_hashed(group)}
    if not of_classes:
        return {}
    # A tracker changes no result.
    helpers = {name.split(".")[0] for name in values.get("allow_targets") or ()}
    helpers -= {module for _, module in named}
    helpers = {
        name
        for name in helpers
        if (spec := _find_spec(name)) is not None and not _is_installed(spec)
    }
    digests = {name: module_digest(name) for name in sorted(of_classes | helpers)}
    return {name: digest for name, digest in digests.items() if digest is not None}


def module_digest(name: str, folder: str | None = None) -> str | None:
    """The sha256 of a top-level module: of its file, or of all code in its package.

    None if it is not found. A module that this process has imported keeps its digest: that is
    the code that runs. With ``folder``, the module is found as by a program that is started
    there, without regard to what this process has imported.
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


def present_digest(name: str) -> str | None:
    """The digest of a user's module as a command that is given here would find it.

    None if it is not found, or installed: an installed package is identified by its version.
    """
    spec = _find_spec(name, os.getcwd())
    return None if spec is None or _is_installed(spec) else _digest_on_disk(spec)


def has_changed_since_import(name: str) -> bool:
    """Return whether a module's files differ from the code that this process has imported."""
    loaded = sys.modules.get(name)
    spec = None if loaded is None else loaded.__spec__
    return spec is not None and module_digest(name) != _digest_on_disk(spec)


def unnamed_modules(before: Collection[str], named: Collection[str]) -> list[str]:
    """The user's modules imported since ``before`` but not ``named``; no key has their code."""
    tops = {name.split(".")[0] for name in sys.modules.keys() - set(before)} - {
        *named,
        PACKAGE.name,
    }
    specs = {top: getattr(sys.modules.get(top), "__spec__", None) for top in tops}
    return sorted(
        top for top, spec in specs.items() if spec is not None and not _is_installed(spec)
    )


def targets_in(values: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every ``_target_`` at any depth, also in lists, as (keys to its mapping, target)."""
    return (
        (inner, value)
        for inner, key, value in entries_of(values, place)
        if key == TARGET and value is not None
    )


def entries_of(
    values: Any, place: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], str, Any]]:
    """Yield every entry at any depth, also in lists, as (keys that lead there, key, value)."""
    if isinstance(values, Mapping | list | tuple):
        for key, value in values.items() if isinstance(values, Mapping) else enumerate(values):
            yield place, str(key), value
            yield from entries_of(value, (*place, str(key)))


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
    """The sha256 of a module's code: of its one file, else of the list of its files' hashes.

    Python counts by its syntax, so that comments, docstrings and format make no other version.
    """
    folders = [Path(place) for place in spec.submodule_search_locations or ()]
    if not folders:
        file = Path(spec.origin or "")
        return _code_digest(file) if spec.has_location and file.is_file() else None
    parts = []
    for folder in folders:
        for file in sorted(folder.rglob("*")):
            if file.suffix in CODE_SUFFIXES and file.is_file():
                parts.append(f"{_code_digest(file)}  {file.relative_to(folder).as_posix()}\n")
    return hashlib.sha256("".join(parts).encode()).hexdigest() if parts else None


def _code_digest(file: Path) -> str:
    if file.suffix != ".py":
        return file_sha256(file)
    return hashlib.sha256(syntax_of(file.read_bytes())).hexdigest()


def _is_installed(spec: ModuleSpec) -> bool:
    """Return whether a module is Python's or an installed package's, whose version counts."""
    places = [spec.origin] if spec.has_location else list(spec.submodule_search_locations or [])
    library = [sysconfig.get_path(key) for key in ("stdlib", "platstdlib")]
    for path in [Path(place) for place in places if place is not None]:
        if not INSTALLED & set(path.parts) and not any(map(path.is_relative_to, library)):
            return False
    return True
