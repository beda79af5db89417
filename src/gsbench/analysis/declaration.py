"""Which metric a verdict was declared to be about (``eval.primary``), when, and which results were there before.

Every change of the declaration is a line of ``<runs>/<experiment>/declared.jsonl``, written when a command is given; a
trial's ``results.json`` repeats what stood when it was run (``declared``) and says when it was measured (``measured``).
"""

from __future__ import annotations

import calendar
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsbench.analysis.results import TrialResult, read_json_lines
from gsbench.runs.layout import DECLARED
from gsbench.words import counted

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


@dataclass(frozen=True)
class ActiveDeclaration:
    """The declaration that holds for an experiment, with what was there before it.

    ``seen`` are the trials that were measured before; ``earlier`` the declarations that it took the place of.
    """

    declaration: Declaration
    seen: tuple[TrialResult, ...]
    trials: int
    earlier: tuple[Declaration, ...]

    @property
    def metric(self) -> str:
        return self.declaration.metric

    @property
    def beforehand(self) -> bool:
        """Whether no result was there yet: only then does the metric stand for itself."""
        return not self.seen

    def sentences(self, name: str) -> list[str]:
        """What a reader must know of the declaration of the metric called ``name``."""
        when = self.declaration.when
        if self.beforehand:
            lines = [
                f"{name} was declared beforehand (eval.primary, {when}), before any of the {self._all()} was measured."
            ]
        else:
            lines = [
                f"{name} was declared when results were there (eval.primary, {when}): {len(self.seen)} of "
                f"the {self._all()} had been measured, so it is adjusted with all other metrics. Trials with "
                "other seeds under another name would test it."
            ]
        lines += [f"Before it, {one.metric} was declared ({one.when})." for one in self.earlier]
        return lines

    def _all(self) -> str:
        return counted(self.trials, "trial")


def read_declarations(folder: Path, trials: Sequence[TrialResult] = ()) -> list[Declaration]:
    """Every declaration for the experiment in ``folder``, the oldest first; also those that only its trials record."""
    records = [*read_json_lines(folder / DECLARED), *(trial.data.get("declared") for trial in trials)]
    found = [declaration for declaration in map(_from_record, records) if declaration is not None]
    return sorted(dict.fromkeys(found), key=lambda declaration: declaration.time)


def standing(folder: Path, trials: Sequence[TrialResult]) -> ActiveDeclaration | None:
    """The declaration that holds for the experiment in ``folder`` with these trials: the latest; None without any."""
    declared = read_declarations(folder, trials)
    if not declared:
        return None
    latest = declared[-1]
    seen = tuple(trial for trial in trials if measured(trial) < latest.time)
    return ActiveDeclaration(latest, seen, len(trials), tuple(declared[:-1]))


def measured(trial: TrialResult) -> float:
    """When the trial's metrics were there, Unix time; of results that do not say it, when they were written."""
    moment = _unix(trial.data.get("measured"))
    return trial.finished if moment is None else moment


def _from_record(record: object) -> Declaration | None:
    if not isinstance(record, dict) or not isinstance(record.get("metric"), str):
        return None
    moment = _unix(record.get("time"))
    return None if moment is None else Declaration(moment, record["metric"])


def _unix(text: object) -> int | None:
    try:
        return calendar.timegm(time.strptime(str(text), STAMP))
    except ValueError:
        return None
