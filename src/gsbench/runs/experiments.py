"""Experiments in a runs folder, their arms, and searches that tune an arm (``tuning.json``)."""

import calendar
import logging
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gsbench.errors import InputError
from gsbench.files import require_no_links
from gsbench.parsing import STRICT, Count, Number, Record, Text, Whole
from gsbench.runs.layout import IN_RUNS
from gsbench.settings import ARM_BYTES, is_folder_name
from gsbench.words import value_words

log = logging.getLogger(__name__)


def list_experiments(runs_dir: Path) -> list[str]:
    """The names of the experiments in a runs folder, sorted."""
    if not runs_dir.is_dir():
        return []
    return sorted(
        Path(folder).name for folder in folders_in(runs_dir) if Path(folder).name not in IN_RUNS
    )


def experiment_home(runs_dir: Path, name: str) -> Path:
    """The folder of the experiment ``name``; raises InputError if there is no such experiment."""
    names = list_experiments(runs_dir)
    if name not in names:
        raise InputError(
            f"no experiment {name!r} in {runs_dir}; there: {', '.join(names) or 'none yet'}"
        )
    return runs_dir / name


def make_home(home: Path) -> None:
    """Make the folder of an experiment; raises InputError if it is a link."""
    require_no_links(home.parent, home)
    home.mkdir(parents=True, exist_ok=True)


def trial_folders(home: Path) -> Iterator[str]:
    """The paths of all folders three levels below ``home`` (scene, arm, trial), in any order."""
    for scene in folders_in(home):
        for arm in folders_in(scene):
            yield from folders_in(arm)


def folders_in(folder: str | Path) -> list[str]:
    """The paths of the folders in ``folder``, without links, hidden folders and strange names."""
    try:
        with os.scandir(folder) as entries:
            found = [
                entry
                for entry in entries
                if entry.is_dir(follow_symlinks=False) and not entry.name.startswith(".")
            ]
    except OSError as error:
        log.warning("left out: %s cannot be read (%s)", folder, error.strerror)
        return []
    paths = []
    for entry in found:
        if is_folder_name(entry.name, ARM_BYTES):
            paths.append(entry.path)
        else:  # such as a line break, or a tag of HTML
            log.warning("left out: %r: gsbench gives no folder such a name", entry.path)
    return paths


# ---- the search for the settings of an arm


class SearchPoint(Record):
    """A point of a search.

    ``value`` is the mean of the metric over its trials, None if one of them has no value.
    """

    settings: dict[str, Whole | Number]
    value: Number | None


class TuningRecord(Record):
    """The search for the settings of ``arm`` (INIT-DENSIFY), which ``sweep`` then trains.

    ``ranges`` are the searched ranges as given, those in ``log`` on a logarithmic scale. ``wanted``
    is the number of points, each judged by trials of ``seeds`` on validation views of ``scenes``.
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
    points: list[SearchPoint]

    def __post_init__(self) -> None:
        if len({frozenset(point.settings) for point in self.points if point.value is not None}) > 1:
            raise ValueError("the points have different settings")
        for point in self.points:
            if any(point.settings.get(key, 1) <= 0 for key in self.log):
                raise ValueError("a setting of a log scale is not above 0")

    @property
    def best(self) -> SearchPoint | None:
        """The (first) point with the best value; None if no point has a value."""
        done = [point for point in self.points if point.value is not None]
        return max(done, key=lambda point: self.direction * (point.value or 0.0), default=None)


# ---- names and times

INTERPOLATION, EXTRAPOLATION = "interpolation", "extrapolation"
# the question of each split (scene.split)
QUESTIONS = {"every_nth": INTERPOLATION, "sector": EXTRAPOLATION}
AT = "@"  # psnr@extrapolation
STAMP = "%Y-%m-%dT%H:%M:%SZ"  # UTC, as in the manifests of the store


@dataclass(frozen=True, order=True)
class Arm:
    """An arm of a comparison: initialiser, densifier, and the swept settings that distinguish it.

    ``variant`` holds (setting, value as text) pairs. The arms of a file of claims have its names
    and no ``init``.
    """

    __pydantic_config__ = STRICT
    __get_pydantic_core_schema__ = Record.__get_pydantic_core_schema__  # texts of one line

    init: str
    densify: str
    variant: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        return f"{self.init}-{self.short}" if self.init else self.short

    @property
    def name(self) -> str:
        """The name without the swept settings: ``sfm-momentum``"""
        return f"{self.init}-{self.densify}" if self.init else self.densify

    @property
    def short(self) -> str:
        """The name without the initialiser: ``momentum[decay=0.9]``"""
        values = ", ".join(
            f"{key.rpartition('.')[2]}={value_words(value)}" for key, value in self.variant
        )
        return f"{self.densify}[{values}]" if values else self.densify

    def has(self, name: str, config: Mapping[str, Any]) -> bool:
        """Return whether a trial of the arm called ``name`` with these settings belongs to it."""
        own = f"{self.init}-{self.densify}"
        return name == own and all(str(config.get(key)) == value for key, value in self.variant)


DEFAULT_METRIC = "psnr"  # of questions and searches


def metric_and_question(primary: str) -> tuple[str, str]:
    """The metric and the question that ``eval.primary`` names; the question is "" for both.

    Examples:
        >>> metric_and_question("psnr@extrapolation")
        ('psnr', 'extrapolation')
        >>> metric_and_question("psnr@far")
        ('psnr@far', '')
    """
    metric, _, question = primary.rpartition(AT)
    return (metric, question) if question in QUESTIONS.values() else (primary, "")


def stamp_now() -> str:
    """The present time as a time stamp (`STAMP`)."""
    return time.strftime(STAMP, time.gmtime())


def unix_time(text: object) -> int | None:
    """The Unix time of a time stamp (`STAMP`); None if the text is not one."""
    try:
        return calendar.timegm(time.strptime(str(text), STAMP))
    except (ValueError, OverflowError):
        return None
