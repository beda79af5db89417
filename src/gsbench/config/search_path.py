"""The places of files that a command names: ``--config-dir``, ``hydra.searchpath``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsbench.config.overrides import key_of, parse_word
from gsbench.config.permissions import PACKAGE, is_allowed, permission_advice
from gsbench.errors import InputError


def search_path(folders: Sequence[Path], overrides: Sequence[str]) -> list[str]:
    """The word ``hydra.searchpath=…`` for ``--config-dir``, in a list; empty without folders."""
    if not folders:
        return []
    if len(folders) > 1 or any(word.startswith("hydra.searchpath=") for word in overrides):
        raise InputError(
            "--config-dir names one folder: for several, give "
            "hydra.searchpath=[file://A,file://B] alone"
        )
    if folders[0] == Path():
        raise InputError("--config-dir needs a folder")
    if not folders[0].is_dir():
        raise InputError(f"--config-dir {folders[0]}: no such folder")
    escaped = str(folders[0].resolve()).replace("'", "\\'")
    return [f"hydra.searchpath=['file://{escaped}']"]


def search_places(words: Sequence[str]) -> list[str]:
    """The places that ``hydra.searchpath`` names.

    Hydra 1.4 also takes ``hydra[searchpath]`` and ``extend_list(pkg://package)``.
    """
    places: list[str] = []
    for word in words:
        override = parse_word(word)
        key = key_of(word).replace("[", ".").replace("]", "")
        if key == "hydra.searchpath" and not override.is_sweep_override():
            value: Any = override.value()
            places += map(str, value if isinstance(value, list) else getattr(value, "values", ()))
    return places


def check_search_path(words: Sequence[str], allowed: Sequence[str]) -> list[str]:
    """Refuse ``hydra.searchpath=[pkg://package]`` for a package that is not ``allowed``.

    Hydra imports such a package while it composes. Returns the packages.
    """
    packages: list[str] = []
    for place in search_places(words):
        scheme, colon, path = place.partition("://")
        if not colon or scheme == "file":
            continue
        packages.append(path.replace("/", "."))
        if scheme != "pkg":
            raise InputError(
                f"hydra.searchpath: {place} is neither a folder (file://…) nor a package (pkg://…)"
            )
        if not is_allowed(packages[-1], (PACKAGE, *allowed)):
            advice = permission_advice([packages[-1].split(".")[0]], allowed)
            raise InputError(
                f"hydra.searchpath: {place} imports a package; if you trust it, {advice}"
            )
    return packages


def searched_folders(words: Sequence[str]) -> list[Path]:
    """The user's folders that ``hydra.searchpath`` among ``words`` names."""
    places = search_places(words)
    return [Path(place.removeprefix("file://")) for place in places if "pkg://" not in place]
