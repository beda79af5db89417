"""Version of a user's own code behind a result: the hash of the file that defines a class. Loads no torch."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

OWN = "gsbench."  # classes below it have no hash: versions of gsbench's stages stand for them
SHOWN = 8  # characters of a hash that people see

_as_imported: dict[str, tuple[ModuleSpec, str]] = {}  # the hash that a module's file had when it was imported


def source_of(target: str) -> dict[str, str]:
    """``{"source": sha256}`` of the file that defines a user's own class, which has no version that we could bump.

    Of a module that this process has imported, it is the file as it was then: that is the code that runs, whatever has
    become of the file since. Empty for gsbench's own classes, and where there is no such file (importing it will say
    what is wrong).
    """
    if target.startswith(OWN):
        return {}
    spec = _spec(target)
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        return {}
    known = _as_imported.get(spec.name)
    if known is not None and known[0] is spec:
        return {"source": known[1]}
    digest = _hash(spec.origin)
    if spec.name in sys.modules:
        _as_imported[spec.name] = (spec, digest)
    return {"source": digest}


def has_changed_since_import(target: str) -> bool:
    """Return whether the file of a class is no longer the one that this process has imported, and therefore runs."""
    spec, source = _spec(target), source_of(target)
    return bool(source) and spec is not None and _hash(str(spec.origin)) != source["source"]


def source_on_disk(target: str, folder: str) -> str | None:
    """The hash of the file of a user's class as a program started in ``folder`` would find it, else None.

    What this process has imported under that name, perhaps from elsewhere, does not count.
    """
    importlib.invalidate_caches()  # the file may be younger than what a finder remembers of its folder
    spec = _find(target.split(".")[:-1], [*sys.path, folder])
    return _hash(spec.origin) if spec and spec.origin and Path(spec.origin).is_file() else None


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


def _hash(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _spec(target: str) -> ModuleSpec | None:
    """Where Python finds, or has found, the module of a class. Imports nothing, no package above it either."""
    module = target.rpartition(".")[0]
    loaded = sys.modules.get(module)
    return _find(module.split(".")) if loaded is None else loaded.__spec__


def _find(names: Sequence[str], path: list[str] | None = None) -> ModuleSpec | None:
    """The module of a dotted name, looked for from ``path`` on (default: where Python looks)."""
    spec = None
    for depth in range(1, len(names) + 1):
        found = (finder.find_spec(".".join(names[:depth]), path, None) for finder in sys.meta_path)
        spec = next((one for one in found if one is not None), None)
        if spec is None:
            return None
        path = list(spec.submodule_search_locations or [])
    return spec
