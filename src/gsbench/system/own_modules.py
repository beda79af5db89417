"""Import of a user's own modules: by the names that were allowed, in one folder, behind what is installed.

The current folder as such is no place of Python's here: a capture may hold a ``plyfile.py``.
"""

import os
import sys
from collections.abc import Mapping, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType

# Python's switch against the current folder as a place of modules, with a value that tells ours from the user's.
SAFE_PATH = ("PYTHONSAFEPATH", "gsbench")


class AllowedModules(MetaPathFinder):
    """Finds modules by their names in the folders of ``folders``, and nothing else there."""

    def __init__(self) -> None:
        self.folders: dict[str, str] = {}

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if path is not None or fullname not in self.folders:
            return None
        return PathFinder.find_spec(fullname, [self.folders[fullname]], target)


_allowed = AllowedModules()  # one, since Python has one list of finders


def allow_modules(allowed: Sequence[str], folder: str | None = None) -> None:
    """Let Python find the modules of ``allow_targets`` in ``folder`` (default: the current one)."""
    take_over(dict.fromkeys((name.split(".")[0] for name in allowed), folder or os.getcwd()))


def allowed_modules() -> dict[str, str]:
    """The modules that were allowed in this process, and the folder of each."""
    return _allowed.folders


def take_over(folders: Mapping[str, str]) -> None:
    """Allow what another process has allowed (`allowed_modules`)."""
    _allowed.folders |= folders
    if _allowed not in sys.meta_path:
        sys.meta_path.append(_allowed)
