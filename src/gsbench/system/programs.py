"""Folders in which programs of others start: never the current folder, which may be a stranger's.

`tests/system/test_programs.py` lists all starts.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

# The variable that removes the current folder from Python's search path, with a value that shows
# that gsbench set it.
SAFE_PATH = ("PYTHONSAFEPATH", "gsbench")
# for programs that neither write nor need files: gsbench's own folder, which is trusted anyway
NEUTRAL = Path(__file__).resolve().parent


def protect_environment() -> None:
    """Take the current folder out of the places where this process looks for code.

    Programs and modules of the current folder must not run, also in the processes that libraries
    start. An empty entry in ``PATH`` or ``PYTHONPATH``, as in ``$PYTHONPATH:/mine``, is the current
    folder.
    """
    os.environ["PATH"] = safe_environment()["PATH"]
    if not os.environ.get(SAFE_PATH[0]):
        os.environ.update([SAFE_PATH])
    given = os.environ.get("PYTHONPATH")
    if not given:
        return
    here, entries = os.path.abspath(""), given.split(os.pathsep)
    places = [(os.path.isabs(entry), os.path.abspath(entry)) for entry in entries]
    kept = [place for is_typed, place in places if is_typed or place != here]
    os.environ["PYTHONPATH"] = os.pathsep.join(kept)
    if len(kept) < len(entries) and here not in kept:
        sys.path[:] = [entry for entry in sys.path if entry != here]


def safe_environment() -> dict[str, str]:
    """The environment of this process, without relative folders such as ``node_modules/.bin``."""
    entries = os.environ.get("PATH", os.defpath).split(os.pathsep)
    return os.environ | {"PATH": os.pathsep.join(filter(os.path.isabs, entries))}


def answer_of(
    command: Sequence[str], seconds: float, environment: Mapping[str, str] | None = None
) -> str | None:
    """The output of a program that needs no files; None if it fails or takes too long.

    It gets the ``environment`` (default: `safe_environment`).
    """
    try:
        return subprocess.run(
            command,
            cwd=NEUTRAL,
            env=environment or safe_environment(),
            capture_output=True,
            encoding="utf-8",
            errors="replace",  # names of files may have any encoding
            timeout=seconds,
            check=True,
        ).stdout
    except (OSError, subprocess.SubprocessError):
        return None


@contextmanager
def own_folder() -> Iterator[Path]:
    """A new empty folder for a program, removed afterwards."""
    with tempfile.TemporaryDirectory(prefix="gsbench-") as made:
        yield Path(made).resolve()


# ---- a user's own modules: only allowed names, from one folder, after installed packages


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
