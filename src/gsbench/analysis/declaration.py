"""Which metric a verdict was declared to be about (``eval.primary``), when, and which results were there before.

`gsbench.runs.declaration` keeps the record; a trial's ``results.json`` says when it was measured (``measured``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsbench.analysis.results import TrialResult
from gsbench.runs.declaration import STOPPING, Declaration, read_declarations, read_plans, unix_time
from gsbench.words import counted


@dataclass(frozen=True)
class ActiveDeclaration:
    """The declaration that holds for an experiment, with what was there before it.

    ``seen`` are the trials that were measured before; ``earlier`` the declarations that it took the place of.
    """

    declaration: Declaration
    seen: tuple[TrialResult, ...]
    trials: int
    earlier: tuple[Declaration, ...]
    looked: bool = False  # seeds were added in planned looks

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
        if self.looked:
            lines.append(
                "Seeds came in planned looks (launch.stop_when_decided): the verdict on top of gsbench report holds "
                "its error rate over them; tests that take numbers of seeds as fixed are too sure of this metric."
            )
        lines += [f"Before it, {one.metric} was declared ({one.when})." for one in self.earlier]
        return lines

    def _all(self) -> str:
        return counted(self.trials, "trial")


def standing(folder: Path, trials: Sequence[TrialResult]) -> ActiveDeclaration | None:
    """The declaration that holds for the experiment in ``folder`` with these trials: the latest; None without any."""
    declared = read_declarations(folder, (trial.data.get("declared") for trial in trials))
    if not declared:
        return None
    latest = declared[-1]
    seen = tuple(trial for trial in trials if measured(trial) < latest.time)
    looked = any(STOPPING in plan.plan for plan in read_plans(folder))
    return ActiveDeclaration(latest, seen, len(trials), tuple(declared[:-1]), looked)


def measured(trial: TrialResult) -> float:
    """When the trial's metrics were there, Unix time; of results that do not say it, when they were written."""
    moment = unix_time(trial.data.get("measured"))
    return trial.finished if moment is None else moment
