"""The experiments of a runs folder, by its folders alone; ``tuning.json`` in that of a search, which tunes an arm."""

import logging
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gsbench.errors import InputError
from gsbench.files import require_no_links
from gsbench.records import Count, Number, Record, Text, Whole, read_typed
from gsbench.runs.layout import IN_RUNS, TUNING

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
    require_no_links(home.parent, home)
    home.mkdir(parents=True, exist_ok=True)


def trial_folders(home: Path) -> Iterator[str]:
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


# ---- the search for the values of an arm


@dataclass(frozen=True, kw_only=True)
class Point(Record):
    """A choice of values; ``value`` is the mean of the metric over its trials, None where one of them has none."""

    settings: dict[str, Whole | Number]
    value: Number | None


@dataclass(frozen=True, kw_only=True)
class TuningRecord(Record):
    """The search for the values of ``arm`` (INIT-DENSIFY) that the experiment ``sweep`` then trained.

    ``ranges`` are what was searched, as it was given, those in ``log`` on a logarithmic scale; ``wanted`` is the number
    of points, each judged by trials of ``seeds`` on validation views of ``scenes``. ``as_it_is`` tells whether the
    first point was the arm with its own values.
    """

    sweep: Text
    arm: Text
    metric: Text
    direction: Literal[-1, 1]
    wanted: Count
    seeds: list[Count]
    scenes: list[str]
    ranges: dict[str, str]
    log: list[str]
    as_it_is: bool
    points: list[Point]

    def __post_init__(self) -> None:
        if len({frozenset(point.settings) for point in self.points if point.value is not None}) > 1:
            raise ValueError("the points have different settings")
        on_scale = (point.settings.get(key) for point in self.points for key in self.log)
        if any(value is not None and value <= 0 for value in on_scale):
            raise ValueError("a setting of a log scale is not above 0")

    @property
    def best(self) -> Point | None:
        """The point of the best value, the first of several; None where none has a value."""
        done = [point for point in self.points if point.value is not None]
        return max(done, key=lambda point: self.direction * (point.value or 0.0), default=None)


def read_tuning(home: Path) -> TuningRecord:
    """The search of the experiment in ``home``; raises FileNotFoundError and DamagedError."""
    return read_typed(home / TUNING, TuningRecord)
