"""The places of files that a command names: ``--config-dir``, ``hydra.searchpath``."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsbench.config.overrides import key_of, parse_word
from gsbench.config.permissions import PACKAGE, is_allowed, permission_advice
from gsbench.errors import InputError

SEARCH_PATH = "hydra.searchpath"
SCHEME = "gsbench"  # of places whose files gsbench reads first (`gsbench.config.strange_files`)


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
    return [_search_word([f"file://{folders[0].resolve()}"])]


def _search_word(places: Sequence[str]) -> str:
    quoted = ("'" + place.replace("'", "\\'") + "'" for place in places)
    return f"hydra.searchpath=[{','.join(quoted)}]"


def read_by_gsbench(words: Sequence[str]) -> list[str]:
    """The ``words``, in which gsbench's source reads the folders of the search path."""
    if not (places := search_places(words)):
        return list(words)
    checked = [
        place if place.startswith("pkg://") else f"{SCHEME}://{place.removeprefix('file://')}"
        for place in places
    ]
    return [*(word for word in words if not _is_search(word)), _search_word(checked)]


def _is_search(word: str) -> bool:
    return key_of(word).replace("[", ".").replace("]", "") == SEARCH_PATH


def search_places(words: Sequence[str]) -> list[str]:
    """The places that ``hydra.searchpath`` names.

    Hydra 1.4 also takes ``hydra[searchpath]`` and ``extend_list(pkg://package)``.
    """
    places: list[str] = []
    for word in words:
        override = parse_word(word)
        if _is_search(word) and not override.is_sweep_override():
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
