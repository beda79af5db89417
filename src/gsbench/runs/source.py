"""Version of a user's own code behind a result: the hash of the files that a class needs. Loads no torch.

These are the file where the configuration finds the class, that which defines it, the packages that these are in, and
what they import of the user's own, at any remove: what lies in their package or beside it, what ``allow_targets``
names, and what Python finds outside its own folders and those of installed packages. They are read, never run, so that
the answer is the same before the code is imported and after.
"""

from __future__ import annotations

import ast
import csv
import hashlib
import importlib
import importlib.util
import os
import sys
import sysconfig
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

from gsbench.system.imports import Imports, read_imports
from gsbench.system.own_modules import PATH_AT_START, AllowedModules, allowed_modules

OWN = "gsbench."  # classes below it have no hash: versions of gsbench's stages stand for them
SHOWN = 8  # characters of a hash that people see
EMPTY = hashlib.sha256().hexdigest()
INSTALLED = frozenset({"site-packages", "dist-packages"})  # folders of packages that are kept by their versions


@dataclass(frozen=True)
class _File:
    """Content of a file of a user's."""

    digest: str
    imports: Imports


_as_imported: dict[str, tuple[ModuleSpec, _File]] = {}  # what a module's file held when it was imported
_as_read: dict[tuple[str, Path], tuple[list[int], _File]] = {}  # files by module and path, each with its state then


def source_of(*targets: str) -> dict[str, str]:
    """``{"source": sha256}`` of the files that a user's own class needs, which have no version that we could bump.

    ``targets`` are import paths, ``package.module.Class``: where a module passes on a class of another, both are its
    names. Of one file it is the sha256 of what it holds, of several that of a list as ``sha256sum`` prints it, with the
    names of modules. A module that this process has imported counts as it was then: that is the code that runs,
    whatever has become of the file since. Empty for gsbench's own classes, and where there is no such file (importing
    it will say what is wrong).
    """
    own = [target for target in targets if not target.startswith(OWN)]
    digest = _Reach(own).digest() if own else None
    return {} if digest is None else {"source": digest}


def has_changed_since_import(target: str) -> bool:
    """Return whether the files of a class are no longer those that this process has imported, and therefore runs."""
    source = source_of(target)
    return bool(source) and _Reach([target], as_imported=False).digest() != source["source"]


def gsbench_imports(*targets: str) -> list[tuple[str, str | None]]:
    """The imports of gsbench in the files of a user's class: modules, and what is taken of each."""
    return sorted(_Reach(targets).of_gsbench, key=str)


def unseen_imports(target: str, before: Collection[str]) -> list[str]:
    """The user's modules that have been imported since ``before`` and that the hash of a class does not know of.

    Their names were computed, or the folder where they lie was: an edit there would go unnoticed.
    """
    known, found = _Reach([target]).paths, []
    for name in sorted(sys.modules.keys() - set(before)):
        spec = getattr(sys.modules.get(name), "__spec__", None)
        if spec is None or f"{name}.".startswith(OWN) or _file_of(spec) is None or _is_installed(spec):
            continue
        if str(_file_of(spec)) not in known:
            found.append(name)
    return found


def source_on_disk(target: str, folder: str) -> str | None:
    """The hash of the files of a user's class as a program started in ``folder`` would find them, else None.

    What this process has imported under these names, perhaps from elsewhere, does not count.
    """
    importlib.invalidate_caches()  # the files may be younger than what a finder remembers of their folder
    return _Reach([target], folder, as_imported=False).digest()


def sources_of(values: Mapping[str, Any]) -> dict[str, str]:
    """``{class: sha256}`` for every user's own class that a configuration names by ``_target_``, at any depth."""
    return {target: found["source"] for target in sorted(set(_targets(values))) if (found := source_of(target))}


def _targets(values: Any) -> Iterator[str]:
    if isinstance(values, Mapping):
        if isinstance(values.get("_target_"), str):
            yield values["_target_"]
        for value in values.values():
            yield from _targets(value)
    elif isinstance(values, list | tuple):
        for value in values:
            yield from _targets(value)


class _Reach:
    """The user's files that a class needs: found from ``folder``, where one is given, else as in this process.

    ``files`` is ``{module: sha256}``; what no import names goes by its path. With ``as_imported``, a module that this
    process has imported counts as it was then.
    """

    def __init__(self, targets: Iterable[str], folder: str | None = None, as_imported: bool = True) -> None:
        self.files: dict[str, str] = {}
        self.paths: set[str] = set()
        self.of_gsbench: set[tuple[str, str | None]] = set()
        self._visited: set[tuple[str, Path]] = set()
        self._folder, self._as_imported = folder, as_imported
        modules = list(dict.fromkeys(target.rpartition(".")[0] for target in targets))
        self._own = {top: self._find_own(top) for top in dict.fromkeys(name.split(".")[0] for name in modules)}
        for module in modules:
            own = [self._own[module.split(".")[0]]]
            if any(name == module and _file_of(spec) for name, spec in _descend(module, own)):
                self._add(module, own)

    def digest(self) -> str | None:
        """One hash for all the files; None where there are none."""
        if len(self.files) < 2:
            return next(iter(self.files.values()), None)
        listed = "".join(f"{digest}  {name}\n" for name, digest in sorted(self.files.items()))
        return hashlib.sha256(listed.encode()).hexdigest()

    def _find_own(self, top: str) -> ModuleSpec | None:
        """Find the package ``top`` of a class: as it was imported, or as Python would find it."""
        if self._folder is not None:
            return _find_top(top, [*sys.path, self._folder])
        loaded = sys.modules.get(top)
        return _find_top(top) if loaded is None else loaded.__spec__

    def _add(self, module: str, tops: Sequence[ModuleSpec | None]) -> None:
        """Add a module, the packages that it is in, and what they import; ``tops`` are what its first name may be."""
        for name, spec in _descend(module, tops):
            file = _file_of(spec)
            if file is None or (name, file) in self._visited:  # a namespace has no file
                continue
            self._visited.add((name, file))
            content = self._read(name, file)
            self._keep(name, file, content.digest)
            if content.imports.computed:
                self._add_folder(name, spec, file)
            places: dict[str, list[ModuleSpec | None]] = {}
            for imported, taken in content.imports.names:
                if f"{imported}.".startswith(OWN):
                    self.of_gsbench.add((imported, taken))
                    continue
                top = imported.split(".")[0]
                if top not in places:
                    places[top] = self._find_imported(top, name, file, content.imports)
                found = places[top]
                self._add(imported if taken in (None, "*") else f"{imported}.{taken}", found)
                if taken == "*":  # which of its modules that takes, a package may say anywhere
                    for inner, package in _descend(imported, found):
                        if inner == imported and package.submodule_search_locations and (init := _file_of(package)):
                            self._add_folder(inner, package, init)

    def _read(self, name: str, file: Path) -> _File:
        """A file as it was when its module was imported, if it was, else as it is."""
        loaded = getattr(sys.modules.get(name), "__spec__", None)
        if not self._as_imported or loaded is None or loaded.origin != str(file):
            return _read(name, file)
        known = _as_imported.get(name)
        if known is None or known[0] is not loaded:
            known = _as_imported[name] = (loaded, _read(name, file))
        return known[1]

    def _add_folder(self, name: str, spec: ModuleSpec, file: Path) -> None:
        """Add all that an import by a computed name may reach: the whole package, or what lies beside a lone file."""
        above = name.count(".") + bool(spec.submodule_search_locations)  # folders from the top package to the file
        top = file.parents[max(0, above - 1)]
        for path in sorted(top.rglob("*.py") if above else top.glob("*.py")):
            if str(path) not in self.paths:
                self._keep(f"{name.split('.')[0]}: {path.relative_to(top).as_posix()}", path, _read("", path).digest)

    def _keep(self, name: str, file: Path, digest: str) -> None:
        self.paths.add(str(file))
        if digest != EMPTY:  # as most packages' own files are
            self.files[name if name not in self.files else f"{name} {len(self.files)}"] = digest

    def _find_imported(self, top: str, importer: str, file: Path, imports: Imports) -> list[ModuleSpec | None]:
        """Places where a file may find the user's package or module ``top``, in order, as long as it is not certain.

        What this process has imported does not count, nor what it has added to ``sys.path``: both may be the doing of
        the code in question, and the answer must be the same before it runs.
        """
        if top in self._own:
            return [self._own[top]]
        known = _find_top(top, [*PATH_AT_START, *([] if self._folder is None else [self._folder])])
        if known is None and top in allowed_modules():
            known = PathFinder.find_spec(top, [allowed_modules()[top]])
        root = file.parents[importer.count(".") + (file.name == "__init__.py")]  # the folder that holds the package
        beside = [root, file.parent]
        if imports.places is None:
            if known is not None:
                return [] if _is_installed(known) else [known]
            return [PathFinder.find_spec(top, [str(root)])]
        beside += [place / named for place in (file.parent, file.parent.parent) for named in imports.places]
        folders = dict.fromkeys(str(place) for place in beside if os.path.isdir(place))
        changed = [PathFinder.find_spec(top, [folder]) for folder in folders]
        return [spec for spec in (known, *changed) if spec is not None and not _is_installed(spec)]


def _descend(module: str, tops: Sequence[ModuleSpec | None]) -> Iterator[tuple[str, ModuleSpec]]:
    """The packages that a module is in, from each of ``tops`` on, and the module itself, as far as they are there."""
    names = module.split(".")
    for spec in tops:
        for depth in range(1, len(names) + 1):
            if spec is None:
                break
            yield ".".join(names[:depth]), spec
            if depth < len(names):
                spec = PathFinder.find_spec(".".join(names[: depth + 1]), list(spec.submodule_search_locations or []))


def _find_top(name: str, path: Sequence[str] | None = None) -> ModuleSpec | None:
    """A module with no package above it, looked for in ``path`` (default: where Python looks); imports nothing."""
    for finder in sys.meta_path:
        if path is not None and isinstance(finder, AllowedModules):
            continue
        spec = finder.find_spec(name, path if finder is PathFinder else None, None)
        if spec is not None:
            return spec
    return None


def _file_of(spec: ModuleSpec) -> Path | None:
    """The file of a module, an archive of modules among them; None for a namespace, and what is built in."""
    if not spec.has_location or spec.origin is None:
        return None
    path = Path(spec.origin)
    return next((place for place in (path, *path.parents) if place.is_file()), None)


def _is_installed(spec: ModuleSpec) -> bool:
    """Return whether a module is Python's own or of an installed package, which its version stands for."""
    if spec.name.split(".")[0] in allowed_modules():
        return False
    places = [spec.origin] if spec.has_location else list(spec.submodule_search_locations or [])
    return all(place is None or _is_installed_at(Path(place)) for place in places)


def _is_installed_at(place: Path) -> bool:
    folder = place.parent
    if INSTALLED & set(folder.parts) or any(
        folder.is_relative_to(sysconfig.get_path(key)) for key in ("stdlib", "platstdlib")
    ):
        return True
    for above in (folder, folder.parent):  # as of `pip install --target`, which leaves the user's files beside its own
        inside = place.relative_to(above).as_posix()
        if any(name == inside or name.startswith(f"{inside}/") for name in _installed_names(above)):
            return True
    return False


@cache
def _installed_names(folder: Path) -> frozenset[str]:
    """List the files that the installed packages in ``folder`` say are theirs, by their paths below it."""
    records = [file for info in folder.glob("*.dist-info") if (file := info / "RECORD").is_file()]
    texts = [file.read_text(encoding="utf-8", errors="replace") for file in records]
    return frozenset(row[0] for text in texts for row in csv.reader(text.splitlines()) if row)


def _read(module: str, path: Path) -> _File:
    """Content of a file; read again only where it has changed."""
    found = path.stat()
    state = [found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino]
    known = _as_read.get((module, path))
    if known is None or known[0] != state:
        content = path.read_bytes()
        known = _as_read[module, path] = (
            state,
            _File(hashlib.sha256(content).hexdigest(), _imports(content, module, path)),
        )
    return known[1]


def _imports(content: bytes, module: str, path: Path) -> Imports:
    if path.suffix != ".py" or not module:
        return Imports()
    try:
        return read_imports(ast.parse(content), module, path.name == "__init__.py")
    except (SyntaxError, ValueError, RecursionError):  # importing it will say so
        return Imports()
