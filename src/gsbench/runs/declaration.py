"""The record of which metric an experiment's verdict was declared to be about (``eval.primary``), and when.

Every change of the declaration is a line of ``<runs>/<experiment>/declared.jsonl``, written when a command is given; a
trial's ``results.json`` repeats what stood when it was run. Plans of claims stand in the same file, each a line of its
own. `gsbench.analysis.declaration` judges by it.
"""

from __future__ import annotations

import calendar
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsbench.files import read_json_lines
from gsbench.runs.layout import DECLARED

STOPPING = "stopping"  # the key of a plan that is of a sweep's looks (launch.stop_when_decided)
STAMP = "%Y-%m-%dT%H:%M:%SZ"  # UTC, as in the manifests of the store


@dataclass(frozen=True)
class Declaration:
    """The metric ``metric`` was declared at ``time`` (Unix, whole seconds)."""

    time: int
    metric: str

    @property
    def when(self) -> str:
        """``2026-11-21 20:05 UTC``"""
        return _readable(self.time)

    def to_record(self) -> dict[str, Any]:
        return {"metric": self.metric, "time": time.strftime(STAMP, time.gmtime(self.time))}


@dataclass(frozen=True)
class DeclaredPlan:
    """The plan of claims with this hash, all that decides about their verdicts, was written down at ``time``."""

    time: int
    hash: str
    plan: dict[str, Any] = field(compare=False, repr=False)

    @property
    def when(self) -> str:
        """As that of a `Declaration`."""
        return _readable(self.time)

    def to_record(self) -> dict[str, Any]:
        return {"plan": self.plan, "hash": self.hash, "time": time.strftime(STAMP, time.gmtime(self.time))}


def read_declarations(folder: Path, repeated: Iterable[object] = ()) -> list[Declaration]:
    """Every declaration for the experiment in ``folder``, the oldest first.

    Those that only results of its trials record are ``repeated``.
    """
    records = [*read_json_lines(folder / DECLARED), *repeated]
    found = [declaration for declaration in map(_from_record, records) if declaration is not None]
    return sorted(dict.fromkeys(found), key=lambda declaration: declaration.time)


def read_plans(folder: Path) -> list[DeclaredPlan]:
    """Every plan of claims that was declared for the experiment in ``folder``, the oldest first."""
    found = [_plan_from_record(record) for record in read_json_lines(folder / DECLARED)]
    return sorted((plan for plan in found if plan is not None), key=lambda plan: plan.time)


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


def _plan_from_record(record: dict[str, Any]) -> DeclaredPlan | None:
    moment = unix_time(record.get("time"))
    if moment is None or not isinstance(record.get("hash"), str) or not isinstance(record.get("plan"), dict):
        return None
    return DeclaredPlan(moment, record["hash"], record["plan"])


def _readable(moment: int) -> str:
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(moment))
