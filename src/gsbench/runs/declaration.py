"""The record of the metric that an experiment's verdict was declared to be about (``eval.primary``): trials and time.

Every change of the declaration is a line of ``<runs>/<experiment>/declared.jsonl``, written when a command is given; a
trial's ``results.json`` repeats what stood when it was run. Plans of claims stand in the same file, each a line of its
own. `gsbench.analysis.declaration` judges by it.
"""

from __future__ import annotations

import calendar
import json
import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from gsbench.parsing import DamagedError, fault_of, read_bytes
from gsbench.records import Count, Part, iterate_rows
from gsbench.runs.layout import DECLARED
from gsbench.runs.trial_record import Declared

log = logging.getLogger(__name__)

INTERPOLATION, EXTRAPOLATION = "interpolation", "extrapolation"
QUESTIONS = {"every_nth": INTERPOLATION, "sector": EXTRAPOLATION}  # what a split (scene.split) asks of a model
AT = "@"  # psnr@extrapolation
STAMP = "%Y-%m-%dT%H:%M:%SZ"  # UTC, as in the manifests of the store


TrialKey = Annotated[str, Field(pattern=r"^[^/]*/[^/]*/[^/]*$")]
STOPPING, TUNED = "stopping", "tuning"  # keys of plans of looks at a sweep, and of tuning
CLAIMS = ""  # plans of claims, which came first and have no key of their own
Planned = Mapping[str, tuple[int, ...]]  # seeds by scene, arm and hash of the configuration (`trial_key`)


def trial_key(scene: str, arm: str, config_hash: str) -> str:
    """The name that tells a trial from others of its experiment but for the seed: ``garden/sfm-adc/3fa9c1d2``."""
    return f"{scene}/{arm}/{config_hash}"


@dataclass(frozen=True)
class Declaration:
    """The metric ``metric``, perhaps of one question, declared at ``time`` (Unix, whole seconds) with all ``trials``
    that were to be run.

    ``trials`` is None where they are not known: in what a trial repeats, and in records of earlier versions.
    """

    time: int
    metric: str
    trials: Planned | None = field(default=None, compare=False, repr=False)

    @property
    def when(self) -> str:
        """``2026-11-21 20:05 UTC``"""
        return _readable(self.time)

    def summary(self) -> Declared:
        """The part that a trial repeats: all but the trials."""
        return Declared(metric=self.metric, time=time.strftime(STAMP, time.gmtime(self.time)))

    def to_record(self) -> dict[str, Any]:
        trials = {} if self.trials is None else {"trials": {key: list(seeds) for key, seeds in self.trials.items()}}
        return self.summary().to_json() | trials


@dataclass(frozen=True)
class DeclaredPlan:
    """Plan of claims with this hash, all that decides about their verdicts, as written down at ``time``.

    ``missing`` says by claim what of it could not be tested there, and why; it decides nothing.
    """

    time: int
    hash: str
    plan: dict[str, Any] = field(compare=False, repr=False)
    missing: Mapping[str, Sequence[str]] = field(default_factory=dict, compare=False, repr=False)

    @property
    def when(self) -> str:
        """The time, as that of a `Declaration`."""
        return _readable(self.time)

    @property
    def kind(self) -> str:
        """The kind of plan: `STOPPING`, `TUNED` or `CLAIMS`; one does not take the place of another kind's."""
        return kind_of_plan(self.plan)

    def to_record(self) -> dict[str, Any]:
        missing = {"missing": {claim: list(lines) for claim, lines in self.missing.items()}} if self.missing else {}
        return {"plan": self.plan, "hash": self.hash, "time": time.strftime(STAMP, time.gmtime(self.time))} | missing


def kind_of_plan(plan: Mapping[str, Any]) -> str:
    """The `DeclaredPlan.kind` of a plan."""
    return next((kind for kind in (STOPPING, TUNED) if kind in plan), CLAIMS)


def metric_and_question(primary: str) -> tuple[str, str]:
    """The metric that ``eval.primary`` names, and the question that it is about; "" for all that were asked.

    Examples:
        >>> metric_and_question("psnr@extrapolation")
        ('psnr', 'extrapolation')
        >>> metric_and_question("psnr")
        ('psnr', '')
    """
    metric, _, question = primary.partition(AT)
    return metric, question


def read_declarations(folder: Path, repeated: Iterable[Declared | None] = ()) -> list[Declaration]:
    """Read every declaration for the experiment in ``folder``, the oldest first.

    Those that only results of its trials record are ``repeated``.
    """
    found = [declared for one in repeated if (declared := _from_record(one)) is not None]
    found += [line.declaration for line in _lines(folder) if line.declaration is not None]
    last = {one: one for one in found}  # of one metric and second the last, which the file says in full
    return sorted(last.values(), key=lambda declaration: declaration.time)


def read_plans(folder: Path, kind: str | None = None) -> list[DeclaredPlan]:
    """Read the plans of a `DeclaredPlan.kind`, or of all, that were declared for the experiment in ``folder``.

    The oldest first.
    """
    found = (line.declared_plan for line in _lines(folder))
    plans = [plan for plan in found if plan is not None and kind in (None, plan.kind)]
    return sorted(plans, key=lambda plan: plan.time)


def standing_plan(plans: Sequence[DeclaredPlan]) -> DeclaredPlan:
    """The latest of ``plans``, which are in the order of time and of one kind, with the time from which on it stood."""
    first = len(plans) - 1
    while first > 0 and plans[first - 1].hash == plans[-1].hash:
        first -= 1
    return plans[first]


def united(one: Planned, other: Planned) -> Planned:
    """The trials of both."""
    return {key: tuple(sorted({*one.get(key, ()), *other.get(key, ())})) for key in {**one, **other}}


def record_text(metrics: Iterable[Declaration], plans: Iterable[DeclaredPlan]) -> str:
    """The content of ``declared.jsonl``, in the order of time."""
    both: list[Declaration | DeclaredPlan] = [*metrics, *plans]
    entries = sorted(both, key=lambda entry: entry.time)
    return "".join(json.dumps(entry.to_record()) + "\n" for entry in entries)


def merged_record(folders: Iterable[Path]) -> str:
    """The content of one ``declared.jsonl`` in the place of those in ``folders``, shares of one experiment.

    A plan that was declared on several machines, with none between, stands with the earliest of its times. Trials that
    a later declaration of a metric brought are added to those of before, as they would be in one folder.
    """
    folders = list(folders)
    plans: list[DeclaredPlan] = []
    latest: dict[str, str] = {}  # hash by kind
    for plan in sorted((plan for folder in folders for plan in read_plans(folder)), key=lambda plan: plan.time):
        if latest.get(plan.kind) != plan.hash:
            plans.append(plan)
        latest[plan.kind] = plan.hash
    metrics: list[Declaration] = []
    declared = [one for folder in folders for one in read_declarations(folder)]
    for one in sorted(declared, key=lambda declaration: declaration.time):
        before: Planned | None = metrics[-1].trials if metrics else {}
        trials = None if before is None or one.trials is None else united(before, one.trials)
        metrics.append(replace(one, trials=trials))
    return record_text(metrics, plans)


def unix_time(text: object) -> int | None:
    """The moment that a stamp names; None for what is none."""
    try:
        return calendar.timegm(time.strptime(str(text), STAMP))
    except (ValueError, OverflowError):
        return None


@dataclass(frozen=True, kw_only=True)
class _Line(Part):
    """A line of ``declared.jsonl``: a metric with its trials' seeds, or a plan of claims with its hash; and when.

    ``missing`` is that of a `DeclaredPlan`; earlier versions wrote none.
    """

    time: str
    metric: str | None = None
    trials: dict[TrialKey, tuple[Count, ...]] | None = None
    plan: dict[str, Any] | None = None
    hash: str | None = None
    missing: dict[str, list[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if unix_time(self.time) is None:
            raise ValueError("time is no moment")
        if fault := fault_of(self.plan):
            raise ValueError(f"in plan {fault}")

    @property
    def declaration(self) -> Declaration | None:
        return None if self.metric is None else Declaration(unix_time(self.time) or 0, self.metric, self.trials)

    @property
    def declared_plan(self) -> DeclaredPlan | None:
        if self.plan is None or self.hash is None:
            return None
        return DeclaredPlan(unix_time(self.time) or 0, self.hash, self.plan, self.missing)


def _lines(folder: Path) -> list[_Line]:
    path = folder / DECLARED
    try:
        content = read_bytes(path)
    except FileNotFoundError:
        return []
    except DamagedError as error:
        log.warning("left out: %s", error)
        return []
    return [line for _, line in iterate_rows(content, _Line, path)]


def _from_record(record: Declared | None) -> Declaration | None:
    moment = None if record is None else unix_time(record.time)
    return None if record is None or moment is None else Declaration(moment, record.metric)


def _readable(moment: int) -> str:
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(moment))
