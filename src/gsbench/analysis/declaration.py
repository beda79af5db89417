"""The declaration that a sweep's verdict is about: what had been measured before it, and what was added later."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gsbench.analysis.results import TrialResult
from gsbench.runs.declaration import Declaration, Planned, Question, read_declarations
from gsbench.words import counted


@dataclass(frozen=True)
class ActiveDeclaration:
    """The declaration that holds for a sweep, with what was there before it and what came after.

    ``declaration`` is the first that named the metric; ``seen`` are the trials that were measured before it; ``added``
    those that were not declared with it while no result was there; ``earlier`` the declarations of other metrics that
    it took the place of.
    """

    declaration: Declaration
    seen: tuple[TrialResult, ...]
    added: tuple[TrialResult, ...]
    trials: int
    earlier: tuple[Declaration, ...]

    @property
    def metric(self) -> str:
        return self._first.metric

    @property
    def question(self) -> str:
        """The one question that the verdict is about: interpolation or extrapolation; "" for all that were asked."""
        return self._first.about

    @property
    def _first(self) -> Question:
        return self.declaration.questions[0]

    @property
    def beforehand(self) -> bool:
        """Return whether metric and trials were fixed before any result: only then the metric stands alone."""
        return not self.seen and not self.added

    def sentences(self, name: str) -> list[str]:
        """Sentences that a reader must know of the declaration of the metric called ``name``."""
        when = self.declaration.when
        name += f" at {self.question}" if self.question else ""
        every = counted(self.trials, "trial")
        if self.seen:
            lines = [
                f"{name} was declared too late (eval.primary, {when}): {len(self.seen)} of the {every} had been "
                "measured. So it is adjusted together with all other metrics. To test it, run other seeds under "
                "another name."
            ]
        elif self.added:
            lines = [
                f"{name} was declared beforehand (eval.primary, {when}), but {len(self.added)} of the {every} were "
                "added after the first result. So it is adjusted together with all other metrics: adding trials until "
                "an effect appears finds effects that do not exist. To test it, run other seeds under another name, "
                "all by one command."
            ]
        else:
            lines = [f"{name} was declared beforehand (eval.primary, {when}), before any of the {every} was measured."]
        planned = sum(map(len, self.declaration.planned.values()))
        missing = planned - (self.trials - len(self.added)) if planned else 0
        if self.declaration.looks:
            lines.append(
                "Seeds come in planned looks (launch.stop_when_decided), and each interval counts all looks; "
                f"{missing} "
                f"of the {planned} declared trials are missing."
            )
        elif missing:
            lines.append(
                f"{missing} of the {planned} declared trials are still missing, so this is an early look. Do not stop "
                "here because the result pleases: that finds effects that do not exist."
            )
        return lines + [f"Declared before it: {one.primary} ({one.when})." for one in self.earlier]


def standing(folder: Path, trials: Sequence[TrialResult]) -> ActiveDeclaration | None:
    """The declaration that holds for the sweep in ``folder`` with these trials: the latest; None without any.

    Trials may be added to it as long as no result is there; later ones cost it its place as soon as they are done.
    """
    every = read_declarations(folder, (trial.record.declared for trial in trials))
    declared = [one for one in every if not one.of_claims]
    if not declared:
        return None
    others = [one for one in declared if one.primary != declared[-1].primary]
    since = [one for one in declared if not others or one.moment > others[-1].moment or one is declared[-1]]
    first_result = min((trial.measured for trial in trials), default=math.inf)
    whole = since[0]
    for later in since[1:]:
        if later.moment < first_result:  # times are whole seconds: what is of the same second may be later
            whole = later
    named = replace(whole, time=since[0].time)
    seen = tuple(trial for trial in trials if trial.measured < named.moment)
    if named.names_trials:
        planned = named.planned
        added = tuple(trial for trial in trials if not _is_planned(trial, planned))
    else:  # the first record may be lost but for what its trials repeat: all since the next may have been added
        again = next((one.moment for one in since if one.names_trials), math.inf)
        added = tuple(trial for trial in trials if trial.measured >= again)
    return ActiveDeclaration(named, seen, added, len(trials), tuple(others))


def _is_planned(trial: TrialResult, planned: Planned) -> bool:
    return trial.seed in planned.get(trial.key, ())
