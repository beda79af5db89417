"""The experiments in a runs folder, and ``tuning.json``, the record of a search that tunes an arm."""

import logging
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gsbench.errors import InputError
from gsbench.files import require_no_links
from gsbench.parsing import Count, Number, Record, Text, Whole, read_typed
from gsbench.runs.layout import IN_RUNS, TUNING

log = logging.getLogger(__name__)


def list_experiments(runs_dir: Path) -> list[str]:
    """The names of the experiments in a runs folder, sorted."""
    if not runs_dir.is_dir():
        return []
    return sorted(Path(folder).name for folder in folders_in(runs_dir) if Path(folder).name not in IN_RUNS)


def experiment_home(runs_dir: Path, name: str) -> Path:
    """The folder of the experiment ``name``; for an unknown name raises InputError that lists the experiments."""
    names = list_experiments(runs_dir)
    if name not in names:
        raise InputError(f"no experiment {name!r} in {runs_dir}; there: {', '.join(names) or 'none yet'}")
    return runs_dir / name


def make_home(home: Path) -> None:
    """Make the folder of an experiment; raises InputError if it is a link."""
    require_no_links(home.parent, home)
    home.mkdir(parents=True, exist_ok=True)


def trial_folders(home: Path) -> Iterator[str]:
    """The paths of all folders three levels below ``home`` (scene, arm, trial), in no particular order."""
    for scene in folders_in(home):
        for arm in folders_in(scene):
            yield from folders_in(arm)


def folders_in(folder: str | Path) -> list[str]:
    """The paths of the folders in ``folder``, without links and hidden folders."""
    try:
        with os.scandir(folder) as entries:
            return [
                entry.path
                for entry in entries
                if entry.is_dir(follow_symlinks=False) and not entry.name.startswith(".")
            ]
    except OSError as error:
        log.warning("left out: %s cannot be read (%s)", folder, error.strerror)
        return []


# ---- the search for the settings of an arm


@dataclass(frozen=True, kw_only=True)
class SearchPoint(Record):
    """A point of a search; ``value`` is the mean of the metric over its trials, None if one of them has no value."""

    settings: dict[str, Whole | Number]
    value: Number | None


@dataclass(frozen=True, kw_only=True)
class TuningRecord(Record):
    """The search for the settings of ``arm`` (INIT-DENSIFY), which the experiment ``sweep`` then trains.

    ``ranges`` are the searched ranges as given, those in ``log`` on a logarithmic scale. ``wanted`` is the number of
    points, each judged by trials of ``seeds`` on validation views of ``scenes``. ``as_it_is`` says whether the first
    point has the arm's own settings.
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
    points: list[SearchPoint]

    def __post_init__(self) -> None:
        if len({frozenset(point.settings) for point in self.points if point.value is not None}) > 1:
            raise ValueError("the points have different settings")
        on_scale = (point.settings.get(key) for point in self.points for key in self.log)
        if any(value is not None and value <= 0 for value in on_scale):
            raise ValueError("a setting of a log scale is not above 0")

    @property
    def best(self) -> SearchPoint | None:
        """The (first) point with the best value; None if no point has a value."""
        done = [point for point in self.points if point.value is not None]
        return max(done, key=lambda point: self.direction * (point.value or 0.0), default=None)


def read_tuning(home: Path) -> TuningRecord:
    """The search of the experiment in ``home``; raises FileNotFoundError and DamagedError."""
    return read_typed(home / TUNING, TuningRecord)
