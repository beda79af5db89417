"""The experiments of a runs folder, by its folders alone."""

from __future__ import annotations

import os
from pathlib import Path

from gsbench.errors import InputError
from gsbench.runs.layout import IN_RUNS


def list_experiments(runs_dir: Path) -> list[str]:
    """The names of the experiments in a runs folder, sorted."""
    if not runs_dir.is_dir():
        return []
    found = (entry for entry in os.scandir(runs_dir) if is_folder(entry) and not entry.name.startswith("."))
    return sorted(entry.name for entry in found if entry.name not in IN_RUNS)


def experiment_home(runs_dir: Path, name: str) -> Path:
    """The folder of the experiment ``name``; raises InputError naming those there are."""
    known = list_experiments(runs_dir)
    if name not in known:
        raise InputError(f"no experiment {name!r} in {runs_dir}; there: {', '.join(known) or 'none yet'}")
    return runs_dir / name


def is_folder(entry: os.DirEntry[str]) -> bool:
    """Return whether an entry is a folder, or a link to one; a link to itself is none."""
    try:
        return entry.is_dir()
    except OSError:
        return False
