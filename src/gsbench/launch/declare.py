"""Writing down which metric, or which plan of looks, a command declares before its trials run. Loads no torch."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.files import write_text
from gsbench.launch.trial import Trial
from gsbench.runs.declaration import Declaration, DeclaredPlan, read_declarations, read_plans
from gsbench.runs.layout import DECLARED
from gsbench.system.locks import hold

log = logging.getLogger(__name__)


def declared_metrics(trials: Sequence[Trial]) -> dict[Path, str | None]:
    """The metric that each experiment's trials declare (``eval.primary``), by its folder; None where none does.

    Raises InputError where trials of one experiment declare different ones.
    """
    found: dict[Path, str | None] = {}
    for trial in trials:
        home = trial.paths.home
        metric, known = trial.values["eval"].get("primary"), found.get(home)
        if metric and known and metric != known:
            raise InputError(
                f"trials of {home.name} declare eval.primary={known} and eval.primary={metric}: a verdict is about one "
                "metric, so give one of them, or run two experiments (name=…)"
            )
        found[home] = known or metric
    return found


def declare(metrics: Mapping[Path, str | None]) -> None:
    """Add to each experiment's record what its trials declare (`declared_metrics`), where it does not stand there yet.

    A declaration is not taken back by a command without one.
    """
    for home, metric in metrics.items():
        home.mkdir(parents=True, exist_ok=True)
        with hold(home / f".{DECLARED}.lock", "the declarations"):
            known = read_declarations(home)
            if known and metric is None:
                log.info("%s: %s stays declared, since %s", home.name, known[-1].metric, known[-1].when)
            if metric is None or (known and known[-1].metric == metric):
                continue
            _write(home, [*known, Declaration(int(time.time()), metric)], read_plans(home))
        if known:
            log.warning(
                "%s: the verdict is from now on about %s, and the report will say that %s was declared before",
                home.name,
                metric,
                known[-1].metric,
            )


def declare_plan(home: Path, plan: Mapping[str, Any], plan_hash: str) -> DeclaredPlan:
    """Add a plan, of claims or of a sweep's looks, to the record of the experiment in ``home``; what stands there.

    One that is the latest there already stands with its time.
    """
    home.mkdir(parents=True, exist_ok=True)
    with hold(home / f".{DECLARED}.lock", "the declarations"):
        known = read_plans(home)
        if known and known[-1].hash == plan_hash:
            return known[-1]
        declared = DeclaredPlan(int(time.time()), plan_hash, dict(plan))
        _write(home, read_declarations(home), [*known, declared])
    if known:
        log.warning(
            "%s: another plan was declared before: trials that were measured under it count as looked at", home.name
        )
    return declared


def _write(home: Path, metrics: Sequence[Declaration], plans: Sequence[DeclaredPlan]) -> None:
    """The whole record, in the order of time."""
    both: list[Declaration | DeclaredPlan] = [*metrics, *plans]
    entries = sorted(both, key=lambda entry: entry.time)
    write_text(home / DECLARED, "".join(json.dumps(entry.to_record()) + "\n" for entry in entries))
