"""``tuning.json``: to which values each arm of a sweep was tuned before its trials ran, and what was tried."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gsbench.records import Count, Part, Text, read_typed
from gsbench.runs.layout import TUNING
from gsbench.runs.search_record import Point, SearchRecord


@dataclass(frozen=True, kw_only=True)
class TunedArm(Part):
    """An arm's ranges, as they were given, and the search in them; without ranges it was left as it is.

    ``experiment`` has the trials of the search; ``as_it_is`` tells whether its first point was the arm untuned.
    """

    ranges: dict[str, str]
    experiment: str | None = None
    as_it_is: bool = False
    search: SearchRecord | None = None

    @property
    def best(self) -> Point | None:
        """The point that was chosen; None of an arm that was left as it is."""
        return None if self.search is None else self.search.best


@dataclass(frozen=True, kw_only=True)
class TuningRecord(Part):
    """Tuned values by the arm's name ``INIT-DENSIFY``; ``hash`` is that of the declared plan, ``seeds`` those of the
    search's trials, ``scenes`` those that it was judged on.
    """

    hash: Text
    metric: Text
    seeds: list[Count]
    scenes: list[str]
    arms: dict[str, TunedArm]


def read_tuning(home: Path) -> TuningRecord:
    """The tuning of the experiment in ``home``; raises FileNotFoundError and DamagedError."""
    return read_typed(home / TUNING, TuningRecord)
