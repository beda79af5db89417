"""Import of a user's own modules: only allowed names, from one folder, after installed packages.

The current folder is not in Python's search path, because a stranger's capture may contain a
``plyfile.py``.
"""

import os
import sys
from collections.abc import Mapping, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType

# The variable that removes the current folder from Python's search path, with a value that shows
# that gsbench set it.
SAFE_PATH = ("PYTHONSAFEPATH", "gsbench")


class AllowedModules(MetaPathFinder):
    """Finds the modules named in ``folders``, each in its folder, and no other modules there."""

    def __init__(self) -> None:
        self.folders: dict[str, str] = {}

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if path is not None or fullname not in self.folders:
            return None
        return PathFinder.find_spec(fullname, [self.folders[fullname]], target)


_allowed = AllowedModules()  # global, as is Python's list of finders


def allow_modules(allowed: Sequence[str], folder: str | None = None) -> None:
    """Let Python find the modules of ``allow_targets`` in ``folder`` (default: the current one)."""
    adopt_modules(dict.fromkeys((name.split(".")[0] for name in allowed), folder or os.getcwd()))


def allowed_modules() -> dict[str, str]:
    """The modules allowed in this process, with their folders."""
    return _allowed.folders


def adopt_modules(folders: Mapping[str, str]) -> None:
    """Allow the modules that another process has allowed (its `allowed_modules`)."""
    _allowed.folders |= folders
    if _allowed not in sys.meta_path:
        sys.meta_path.append(_allowed)
