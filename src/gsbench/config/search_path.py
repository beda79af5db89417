"""The user's folders of configurations: ``--config-dir``, ``hydra.searchpath``, and their files.

Hydra resolves ``${…}`` already while it follows defaults lists, so that a check of the composed
configuration would come too late: a secret would be the name of a choice by then. So Hydra reads
the user's folders through a source of gsbench's (`hydra_plugins.gsbench.GsbenchFiles`), which asks
`check_file` for each file that is needed.
"""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

from gsbench.config.overrides import key_of, parse_word
from gsbench.config.trust import PACKAGE, check_texts, is_allowed, permission_advice
from gsbench.errors import InputError
from gsbench.parsing import SafeLoader, read_yaml, resolved

SEARCH_PATH = "hydra.searchpath"
SCHEME = "gsbench"  # of places whose files gsbench reads first (`check_file`)


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


def check_search_path(words: Sequence[str], allowed: Sequence[str]) -> None:
    """Refuse a place that is missing, of which Hydra only warns, and a package not ``allowed``.

    Hydra imports a package (``pkg://package``) while it composes.
    """
    for place in search_places(words):
        scheme, colon, path = place.partition("://")
        if not colon or scheme == "file":
            if not Path(path or place).is_dir():
                raise InputError(f"hydra.searchpath names {path or place}: no such folder")
            continue
        if scheme != "pkg":
            raise InputError(
                f"hydra.searchpath: {place} is neither a folder (file://…) nor a package (pkg://…)"
            )
        package = path.replace("/", ".")
        if not is_allowed(package, (PACKAGE, *allowed)):
            advice = permission_advice([package.split(".")[0]], allowed)
            raise InputError(
                f"hydra.searchpath: {place} imports a package; if you trust it, {advice}"
            )
        try:
            found = find_spec(package)
        except Exception as error:  # it may raise anything: the packages above it are imported
            raise InputError(f"hydra.searchpath: {place} cannot be imported ({error})") from error
        if found is None:
            raise InputError(f"hydra.searchpath names {package}: no such package")


def searched_folders(words: Sequence[str]) -> list[Path]:
    """The user's folders that ``hydra.searchpath`` among ``words`` names."""
    places = search_places(words)
    return [Path(place.removeprefix("file://")) for place in places if "pkg://" not in place]


# ---- files in these folders

# An entry of a defaults list: a file or a group, perhaps with a package. Its path is written out.
NAME = r"[\w-](?:[\w .-]*[\w-])?"
ENTRY = re.compile(rf"((override|optional)\s+)?/?{NAME}(/{NAME})*(@[\w.]*(:[\w.]*)?)?")
# Parts of a path that lead out of a folder, also if a text in front of them is resolved to nothing.
LEAVING = re.compile(r"(^|[/}])\.+(?=$|[/$])")


class _TextLoader(SafeLoader):
    """A loader for which a date is a text, as for Hydra."""

    yaml_implicit_resolvers: ClassVar[Any] = {
        letter: [kind for kind in kinds if kind[0] != "tag:yaml.org,2002:timestamp"]
        for letter, kinds in SafeLoader.yaml_implicit_resolvers.items()
    }


# permissions of the command line, for the files that Hydra reads within `permitted_to_files`
_allowed: ContextVar[tuple[str, ...]] = ContextVar("allowed", default=())


@contextmanager
def permitted_to_files(allowed: Sequence[str]) -> Iterator[None]:
    """Let the files that Hydra reads within the block use what the command line allows."""
    token = _allowed.set(tuple(allowed))
    try:
        yield
    finally:
        _allowed.reset(token)


def check_file(folder: str, config_path: str) -> None:
    """Raise InputError, with the file's name, unless Hydra may read a file of the ``folder``.

    It has no more values and levels than `read_yaml` takes, the entries of its defaults list stay
    in the groups' folders, and its ``${…}`` read only what every file may read, or what is allowed.
    """
    name = config_path if config_path.endswith(".yaml") else f"{config_path}.yaml"
    file = resolved(Path(folder, name))
    if not file.is_file():
        return  # Hydra reports it
    values = read_yaml(file, _TextLoader)
    shown = os.path.relpath(file, resolved(Path(folder)))
    check_texts(values, _allowed.get(), shown)
    for entry in (values.get("defaults") or []) if isinstance(values, dict) else []:
        for key, choice in entry.items() if isinstance(entry, dict) else [(entry, "")]:
            _check_entry(shown, key, choice)


def _check_entry(file: str, key: Any, choice: Any) -> None:
    """Refuse an entry of a defaults list that leads to a file outside the places of files."""
    if not ENTRY.fullmatch(str(key)):
        raise InputError(
            f"{file}: defaults: {key!r} must name a group or a file, as scene or /scene"
        )
    for name in map(str, choice if isinstance(choice, list) else [choice]):
        check_choice(f"{file}: defaults: {key}: {name}", name)


def check_choice(where: str, name: str) -> None:
    """Refuse a choice in a group that leads out of the group's folder."""
    # The texts in a resolver's call could become parts of the path.
    calls = re.sub(r"\b(oc\.\w+|python_version|now|hydra):", "", name)
    if LEAVING.search(name) or name.startswith("/") or ("." in calls and calls != name):
        raise InputError(f"{where}: Parent traversal ('..') is refused: name a file of the group")
