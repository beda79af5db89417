"""``tuning.json`` in the experiment of a search: what was searched for an arm of a sweep, and what was found."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gsbench.records import Count, Number, Record, Text, Whole, read_typed
from gsbench.runs.layout import TUNING


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
