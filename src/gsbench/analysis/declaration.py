"""Declaration of the metric that a verdict is about (``eval.primary``): its time, and the results that came before it.

`gsbench.runs.declaration` keeps the record; a trial's ``results.json`` says when it was measured (``measured``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsbench.analysis.results import TrialResult
from gsbench.runs.declaration import Declaration, read_declarations, unix_time
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

    @property
    def metric(self) -> str:
        return self.declaration.metric

    @property
    def beforehand(self) -> bool:
        """Return whether no result was there yet: only then does the metric stand for itself."""
        return not self.seen

    def sentences(self, name: str) -> list[str]:
        """Sentences that a reader must know of the declaration of the metric called ``name``."""
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


def standing(folder: Path, trials: Sequence[TrialResult]) -> ActiveDeclaration | None:
    """The declaration that holds for the experiment in ``folder`` with these trials: the latest; None without any."""
    declared = read_declarations(folder, (trial.record.declared for trial in trials))
    if not declared:
        return None
    latest = declared[-1]
    seen = tuple(trial for trial in trials if measured(trial) < latest.time)
    return ActiveDeclaration(latest, seen, len(trials), tuple(declared[:-1]))


def measured(trial: TrialResult) -> float:
    """The Unix time at which the trial's metrics were there; of results that do not say it, that of the file."""
    moment = None if trial.record.measured is None else unix_time(trial.record.measured)
    return trial.finished if moment is None else moment
