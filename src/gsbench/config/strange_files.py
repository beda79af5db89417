"""Files of configurations in the user's folders, checked before Hydra resolves anything in them.

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

from gsbench.config.explain import explained
from gsbench.config.permissions import check_texts
from gsbench.errors import InputError
from gsbench.parsing import SafeLoader, read_yaml, resolved

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


def check_places(folders: Sequence[Path], packages: Sequence[str]) -> None:
    """Refuse a missing place of files, of which Hydra only warns."""
    for package in packages:
        with explained([]):
            spec = find_spec(package)
        if spec is None:
            raise InputError(f"hydra.searchpath names {package}: no such package")
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"hydra.searchpath names {folder}: no such folder")


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
