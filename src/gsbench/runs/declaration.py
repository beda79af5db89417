"""The record of the metric that an experiment's verdict was declared to be about (``eval.primary``): trials and time.

Every change of the declaration is a line of ``<runs>/<experiment>/declared.jsonl``, written when a command is given; a
trial's ``results.json`` repeats what stood when it was run. Plans of claims stand in the same file, each a line of its
own. `gsbench.analysis.declaration` judges by it.
"""

from __future__ import annotations

import calendar
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsbench.files import read_json_lines
from gsbench.runs.layout import DECLARED

STAMP = "%Y-%m-%dT%H:%M:%SZ"  # UTC, as in the manifests of the store


Planned = Mapping[str, tuple[int, ...]]  # seeds by scene, arm and hash of the configuration (`trial_key`)


def trial_key(scene: str, arm: str, config_hash: str) -> str:
    """What tells a trial from others of its experiment but for the seed: ``garden/sfm-adc/3fa9c1d2``."""
    return f"{scene}/{arm}/{config_hash}"


@dataclass(frozen=True)
class Declaration:
    """The metric ``metric`` was declared at ``time`` (Unix, whole seconds), with all ``trials`` that were to be run.

    ``trials`` is None where they are not known: in what a trial repeats, and in records of earlier versions.
    """

    time: int
    metric: str
    trials: Planned | None = field(default=None, compare=False, repr=False)

    @property
    def when(self) -> str:
        """``2026-11-21 20:05 UTC``"""
        return _readable(self.time)

    def summary(self) -> dict[str, Any]:
        """What a trial repeats of it: all but the trials."""
        return {"metric": self.metric, "time": time.strftime(STAMP, time.gmtime(self.time))}

    def to_record(self) -> dict[str, Any]:
        trials = {} if self.trials is None else {"trials": {key: list(seeds) for key, seeds in self.trials.items()}}
        return self.summary() | trials


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
    records = [*repeated, *read_json_lines(folder / DECLARED)]
    found = [declaration for declaration in map(_from_record, records) if declaration is not None]
    last = {one: one for one in found}  # of one metric and second the last, which the file says in full
    return sorted(last.values(), key=lambda declaration: declaration.time)


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
    return None if moment is None else Declaration(moment, record["metric"], _planned(record.get("trials")))


def _planned(trials: object) -> Planned | None:
    if not isinstance(trials, dict):
        return None
    return {
        str(key): tuple(seed for seed in seeds if isinstance(seed, int))
        for key, seeds in trials.items()
        if isinstance(seeds, list) and str(key).count("/") == 2
    }


def _plan_from_record(record: dict[str, Any]) -> DeclaredPlan | None:
    moment = unix_time(record.get("time"))
    if moment is None or not isinstance(record.get("hash"), str) or not isinstance(record.get("plan"), dict):
        return None
    return DeclaredPlan(moment, record["hash"], record["plan"])


def _readable(moment: int) -> str:
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(moment))
