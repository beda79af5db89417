"""The declaration that a sweep's verdict follows.

It comes with the trials that were measured before it, and those that were added later.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gsbench.analysis.results import TrialResult
from gsbench.runs.experiments import Declaration, read_declarations
from gsbench.words import counted


@dataclass(frozen=True)
class ActiveDeclaration:
    """The declaration that holds for a sweep of ``trials`` trials.

    ``declaration`` has the time of the first declaration of the metric, and the trials declared up
    to the first result. ``seen`` are the trials that were measured before that time; ``added`` are
    the trials that were not declared before the first result. ``earlier`` are the declarations of
    other metrics that this one replaced.
    """

    declaration: Declaration
    seen: tuple[TrialResult, ...]
    added: tuple[TrialResult, ...]
    trials: int
    earlier: tuple[Declaration, ...]

    @property
    def metric(self) -> str:
        return self.declaration.questions[0].metric

    @property
    def question(self) -> str:
        """The question of the verdict, interpolation or extrapolation; "" if it is about both."""
        return self.declaration.questions[0].about

    @property
    def beforehand(self) -> bool:
        """Return whether metric and trials were fixed before any result.

        Only then the metric is tested alone.
        """
        return not self.seen and not self.added

    def sentences(self, name: str) -> list[str]:
        """Sentences that say when the metric called ``name`` was declared, and for which trials."""
        when = self.declaration.when
        name += f" at {self.question}" if self.question else ""
        all_trials = counted(self.trials, "trial")
        if self.seen:
            lines = [
                f"{name} was declared too late (eval.primary, {when}): {len(self.seen)} of the "
                f"{all_trials} had been "
                "measured. So it is adjusted together with all other metrics. To test it, run "
                "other seeds under "
                "another name."
            ]
        elif self.added:
            lines = [
                f"{name} was declared beforehand (eval.primary, {when}), but {len(self.added)} of "
                f"the {all_trials} "
                "were added after the first result. So it is adjusted together with all other "
                "metrics: adding trials "
                "until an effect appears finds effects that do not exist. To test it, run other "
                "seeds under another "
                "name, all by one command."
            ]
        else:
            lines = [
                f"{name} was declared beforehand (eval.primary, {when}), before any of the "
                f"{all_trials} was measured."
            ]
        planned = sum(map(len, self.declaration.planned.values()))
        missing = planned - (self.trials - len(self.added)) if planned else 0
        if self.declaration.looks:
            lines.append(
                "Seeds come in planned looks (launch.stop_when_decided), and each interval counts "
                "all looks; "
                f"{missing} of the {planned} declared trials are missing."
            )
        elif missing:
            lines.append(
                f"{missing} of the {planned} declared trials are still missing, so this is an "
                "early look. Do not stop "
                "here because the result pleases: that finds effects that do not exist."
            )
        return lines + [f"Declared before it: {one.primary} ({one.when})." for one in self.earlier]


def active_declaration(folder: Path, trials: Sequence[TrialResult]) -> ActiveDeclaration | None:
    """The declaration in force for the sweep in ``folder``; None if nothing was declared.

    ``trials`` are all trials of the sweep. The latest declaration of a metric is in force.
    Further commands may add trials to it until the first result; a trial that is added later
    counts as ``added`` as soon as it is measured.
    """
    recorded = read_declarations(folder, (trial.record.declared for trial in trials))
    declared = [one for one in recorded if one.kind == "sweep"]
    if not declared:
        return None
    others = [one for one in declared if one.primary != declared[-1].primary]
    current = [
        one
        for one in declared
        if not others or one.moment > others[-1].moment or one is declared[-1]
    ]
    first_result = min((trial.measured for trial in trials), default=math.inf)
    # Each command's record repeats the trials of the records before it, so the last valid record
    # names them all.
    complete = current[0]
    for later in current[1:]:
        # times are whole seconds: a declaration of the same second may be later
        if later.moment < first_result:
            complete = later
    declaration = replace(complete, time=current[0].time)
    seen = tuple(trial for trial in trials if trial.measured < declaration.moment)
    if declaration.names_trials:
        planned = declaration.planned
        added = tuple(trial for trial in trials if trial.seed not in planned.get(trial.key, ()))
    else:
        # The record's file may be lost, and the trials' results repeat only its metric and time.
        # Then every trial that was measured after the next record with trials may have been added.
        next_record = next((one.moment for one in current if one.names_trials), math.inf)
        added = tuple(trial for trial in trials if trial.measured >= next_record)
    return ActiveDeclaration(declaration, seen, added, len(trials), tuple(others))
