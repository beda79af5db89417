"""The record of which metric an experiment's verdict was declared to be about (``eval.primary``), and when.

Every change of the declaration is a line of ``<runs>/<experiment>/declared.jsonl``, written when a command is given; a
trial's ``results.json`` repeats what stood when it was run. `gsbench.analysis.declaration` judges by it.
"""

from __future__ import annotations

import calendar
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsbench.files import read_json_lines
from gsbench.runs.layout import DECLARED

STAMP = "%Y-%m-%dT%H:%M:%SZ"  # UTC, as in the manifests of the store


@dataclass(frozen=True)
class Declaration:
    """The metric ``metric`` was declared at ``time`` (Unix, whole seconds)."""

    time: int
    metric: str

    @property
    def when(self) -> str:
        """``2026-11-21 20:05 UTC``"""
        return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(self.time))

    def to_record(self) -> dict[str, Any]:
        return {"metric": self.metric, "time": time.strftime(STAMP, time.gmtime(self.time))}


def read_declarations(folder: Path, repeated: Iterable[object] = ()) -> list[Declaration]:
    """Every declaration for the experiment in ``folder``, the oldest first.

    Those that only results of its trials record are ``repeated``.
    """
    records = [*read_json_lines(folder / DECLARED), *repeated]
    found = [declaration for declaration in map(_from_record, records) if declaration is not None]
    return sorted(dict.fromkeys(found), key=lambda declaration: declaration.time)


def unix_time(text: object) -> int | None:
    """The moment that a stamp names; None for what is none."""
    try:
        return calendar.timegm(time.strptime(str(text), STAMP))
    except ValueError:
        return None


def _from_record(record: object) -> Declaration | None:
    if not isinstance(record, dict) or not isinstance(record.get("metric"), str):
        return None
    moment = unix_time(record.get("time"))
    return None if moment is None else Declaration(moment, record["metric"])
