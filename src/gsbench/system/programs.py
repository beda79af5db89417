"""Folders in which programs of others start: never the current folder, which may be a stranger's.

npm reads ``node_modules`` and ``.npmrc`` in the folder where it starts and in each folder above
it; other programs have similar habits. `tests/system/test_programs.py` lists all starts.
"""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsbench.errors import GsbenchError

# for programs that neither write nor need files: gsbench's own folder, which is trusted anyway
NEUTRAL = Path(__file__).resolve().parent


def safe_environment() -> dict[str, str]:
    """The environment of this process, without relative folders such as ``node_modules/.bin``."""
    entries = os.environ.get("PATH", os.defpath).split(os.pathsep)
    return os.environ | {"PATH": os.pathsep.join(filter(os.path.isabs, entries))}


def find_program(name: str) -> str | None:
    """The absolute path of a program in `safe_environment`, or None."""
    found = shutil.which(name, path=safe_environment()["PATH"])
    # Windows looks in the current folder first.
    return found if found and os.path.isabs(found) else None


@contextmanager
def own_folder(*read_above: str) -> Iterator[Path]:
    """A new empty folder for a program, removed afterwards.

    Raises GsbenchError if one of the names that the program would read lies in a folder above it.
    """
    with tempfile.TemporaryDirectory(prefix="gsbench-") as made:
        folder = Path(made).resolve()
        for above in folder.parents:
            for name in read_above:
                if os.path.lexists(above / name):
                    raise GsbenchError(
                        f"{above / name} would be read by a program: remove it, or set TMPDIR to a "
                        "folder that has nothing of the kind above it"
                    )
        yield folder
