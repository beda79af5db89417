"""The code behind a trial: gsbench's own, package by package, and the user's, module by module.

A *package* is here a folder of gsbench or one of its files. If it is as released
(``released.json``), the versions of gsbench's stages stand for its code. Else a digest of its
syntax does. The user's modules are those of configured classes and those in ``allow_targets``,
except those of trackers: no others can be imported. A module counts whole, Python by its syntax,
other code by its bytes. Loads no torch.
"""

import ast
import hashlib
import importlib.util
import json
import platform
import sys
import sysconfig
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field

from gsbench.files import file_sha256, user_cache, write_json
from gsbench.parsing import SafeLoader, read_if_sound
from gsbench.runs.configuration import GSBENCH, Values, determining_settings, sha256_of, targets_in

PACKAGE = Path(__file__).resolve().parents[1]
RELEASED = "released.json"  # in gsbench's folder: the digests of all packages at the release
AS_RELEASED = "released"  # the state of a package that equals the release
DIGEST_CHARACTERS = 16
SYNTAX_DIGESTS = "syntax.json"  # in the user's cache
MAX_KEPT = 500  # digests in that file
KeptDigests = dict[str, Annotated[str, Field(pattern=f"^[0-9a-f]{{{DIGEST_CHARACTERS}}}$")]]


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
    digest = _digest_of_syntax(contents, f"{_parsers()} {digest}")
    return AS_RELEASED if digest == released.get("syntax") else digest


def _digest_of_syntax(contents: Mapping[str, bytes], key: str) -> str:
    """The digest of the syntax of files, which the user's cache keeps by a ``key`` of them.

    Parsing all of gsbench takes a second.
    """
    file = user_cache("code") / SYNTAX_DIGESTS
    known = _kept_digests(file)
    if key not in known:
        known[key] = _digest({name: syntax_of(content, name) for name, content in contents.items()})
        with suppress(OSError):  # only slower without
            file.parent.mkdir(parents=True, exist_ok=True)
            write_json(file, dict(list(known.items())[-MAX_KEPT:]))
    return known[key]


@cache
def _kept_digests(file: Path) -> dict[str, str]:
    """The digests in the user's cache as this process first found them, and its own since."""
    return read_if_sound(file, KeptDigests) or {}


@cache
def _parsers() -> str:
    """The versions of all that computes a digest of syntax: this file, Python and PyYAML."""
    own = file_sha256(Path(__file__))[:DIGEST_CHARACTERS]
    return f"{own} {platform.python_version()} {yaml.__version__}"


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
    return read_if_sound(PACKAGE / RELEASED, dict[str, dict[str, str]]) or {}


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


# ---- the user's code

# the setting that says what may run; it counts on the command line only
PERMISSIONS = "allow_targets"
# packages in these folders are identified by their versions
INSTALLED = frozenset({"site-packages", "dist-packages"})
CODE_SUFFIXES = frozenset({".py", ".so", ".pyd", ".c", ".cpp", ".cu", ".h", ".cuh"})

# a module's digest when it was first asked for
_digests_at_import: dict[str, tuple[ModuleSpec, str | None]] = {}


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
        paths = self.targets.get(place, GSBENCH), f"{type(component).__module__}."
        return not all(path.startswith(GSBENCH) for path in paths)


NO_USER_CODE = UserCode()


def user_modules(values: Mapping[str, Any]) -> dict[str, str]:
    """``{module: sha256}`` of the user's code behind a configuration; {} if there is none.

    These are the modules of its classes, without trackers, and the modules in ``allow_targets``,
    which the classes may import. An installed module is included only if a class comes from it.
    """
    named = [(place, name) for place, name in targets_in(values) if not name.startswith(GSBENCH)]
    of_classes = {name.split(".")[0] for place, name in named if place[0] != "tracking"}
    if not of_classes:
        return {}
    helpers = {name.split(".")[0] for name in values.get(PERMISSIONS) or ()}
    helpers -= {name.split(".")[0] for _, name in named}
    helpers = {
        name
        for name in helpers
        if (spec := _find_spec(name)) is not None and not _is_installed(spec)
    }
    digests = {name: module_digest(name) for name in sorted(of_classes | helpers)}
    return {name: digest for name, digest in digests.items() if digest is not None}


def module_digest(name: str) -> str | None:
    """The sha256 of a top-level module: of its file, or of all code in its package.

    None if it is not found. A module that this process has imported keeps its digest: that is
    the code that runs.
    """
    loaded = sys.modules.get(name)
    spec = _find_spec(name) if loaded is None else loaded.__spec__
    if spec is None:
        return None
    if loaded is None:
        return _digest_on_disk(spec)
    cached = _digests_at_import.get(name)
    if cached is None or cached[0] is not spec:
        cached = _digests_at_import[name] = (spec, _digest_on_disk(spec))
    return cached[1]


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


def _find_spec(name: str) -> ModuleSpec | None:
    """A top-level module as Python would find it, without importing it."""
    importlib.invalidate_caches()  # a finder caches the content of folders, and files may be newer
    try:
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


# ---- settings and code together


def config_hash(values: Values) -> str:
    """sha256 of the settings and the user's code that determine a result, without the seed.

    Names, devices, folders, tracking and launchers do not change it.
    """
    modules = user_modules(values)
    return sha256_of(determining_settings(values) | ({"code": modules} if modules else {}))
