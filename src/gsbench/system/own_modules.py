"""Where Python finds a user's own modules: by the names that were allowed, in one folder, behind what is installed.

The current folder as such is no place of Python's here: a capture may hold a ``plyfile.py``.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType

# Python's switch against the current folder as a place of modules, with a value that tells ours from the user's.
SAFE_PATH = ("PYTHONSAFEPATH", "gsbench")


class AllowedModules(MetaPathFinder):
    """Finds modules by ``names`` in ``folder``, and nothing else there."""

    def __init__(self) -> None:
        self.folder, self.names = "", frozenset[str]()

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if path is not None or fullname not in self.names:
            return None
        return PathFinder.find_spec(fullname, [self.folder], target)


_allowed_modules = AllowedModules()  # one, since Python has one list of finders


def import_only(allowed: Sequence[str], folder: str | None = None) -> None:
    """Let Python find, in ``folder`` (default: the current one), the modules of ``allow_targets``, and no others."""
    _allowed_modules.folder = folder or os.getcwd()
    _allowed_modules.names = frozenset(name.split(".")[0] for name in allowed)
    if _allowed_modules not in sys.meta_path:
        sys.meta_path.append(_allowed_modules)


def importable() -> tuple[list[str], str]:
    """The names and the folder that `import_only` was given last, for another process."""
    return sorted(_allowed_modules.names), _allowed_modules.folder
