"""The experiments of a runs folder, by its folders alone."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from pathlib import Path

from gsbench.errors import InputError
from gsbench.files import require_own
from gsbench.runs.layout import IN_RUNS

log = logging.getLogger(__name__)


def list_experiments(runs_dir: Path) -> list[str]:
    """The names of the experiments in a runs folder, sorted."""
    if not runs_dir.is_dir():
        return []
    return sorted(Path(place).name for place in folders_in(runs_dir) if Path(place).name not in IN_RUNS)


def experiment_home(runs_dir: Path, name: str) -> Path:
    """The folder of the experiment ``name``; raises InputError naming those there are."""
    known = list_experiments(runs_dir)
    if name not in known:
        raise InputError(f"no experiment {name!r} in {runs_dir}; there: {', '.join(known) or 'none yet'}")
    return runs_dir / name


def make_home(home: Path) -> None:
    """Make the folder of an experiment; raises InputError where it is a link."""
    require_own(home.parent, home)
    home.mkdir(parents=True, exist_ok=True)


def places_of_trials(home: Path) -> Iterator[str]:
    """Every folder three levels below the experiment in ``home``, in no particular order."""
    for scene in folders_in(home):
        for arm in folders_in(scene):
            yield from folders_in(arm)


def folders_in(place: str | Path) -> list[str]:
    """The folders in ``place`` without the hidden ones; no link is one."""
    try:
        with os.scandir(place) as entries:
            return [
                entry.path
                for entry in entries
                if entry.is_dir(follow_symlinks=False) and not entry.name.startswith(".")
            ]
    except OSError as error:
        log.warning("left out: %s cannot be read (%s)", place, error.strerror)
        return []
