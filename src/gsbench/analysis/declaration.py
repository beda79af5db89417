"""Declaration of the metric that a verdict is about (``eval.primary``): its time, the results that came before it, and
the trials that were added later.

`gsbench.runs.declaration` keeps the record; a trial's ``results.json`` says when it was measured (``measured``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gsbench.analysis.results import TrialResult
from gsbench.runs.declaration import (
    STOPPING,
    Declaration,
    metric_and_question,
    read_declarations,
    read_plans,
    trial_key,
    unix_time,
)
from gsbench.words import counted, listed


@dataclass(frozen=True)
class ActiveDeclaration:
    """The declaration that holds for an experiment, with what was there before it and what came after.

    ``declaration`` is the first that named the metric; ``seen`` are the trials that were measured before it; ``added``
    those that were not declared with it while no result was there; ``earlier`` the declarations of other metrics that
    it took the place of.
    """

    declaration: Declaration
    seen: tuple[TrialResult, ...]
    added: tuple[TrialResult, ...]
    trials: int
    earlier: tuple[Declaration, ...]
    looks: bool = False  # whether its trials came in planned looks

    @property
    def metric(self) -> str:
        return metric_and_question(self.declaration.metric)[0]

    @property
    def question(self) -> str:
        """The one question that the verdict is about: interpolation or extrapolation; "" for all that were asked."""
        return metric_and_question(self.declaration.metric)[1]

    @property
    def beforehand(self) -> bool:
        """Return whether metric and trials were fixed before any result: only then the metric stands alone."""
        return not self.seen and not self.added

    def sentences(self, name: str) -> list[str]:
        """Sentences that a reader must know of the declaration of the metric called ``name``."""
        when = self.declaration.when
        name += f" at {self.question}" if self.question else ""
        if self.seen:
            lines = [
                f"{name} was declared when results were there (eval.primary, {when}): {len(self.seen)} of "
                f"the {self._all()} had been measured, so it is adjusted with all other metrics. Trials with "
                "other seeds under another name would test it."
            ]
        elif self.added:
            lines = [
                f"{name} was declared beforehand (eval.primary, {when}), but {len(self.added)} of the {self._all()} "
                f"were added when results were there ({self._what_was_added()}), so it is adjusted with all other "
                "metrics: who adds trials until something is found will find something. Trials with other seeds under "
                "another name, all asked for by one command, would test it."
            ]
        else:
            lines = [
                f"{name} was declared beforehand (eval.primary, {when}), before any of the {self._all()} was measured."
            ]
        planned = sum(map(len, (self.declaration.trials or {}).values()))
        missing = planned - (self.trials - len(self.added)) if planned else 0
        if self.looks:
            lines.append(
                f"Seeds came in planned looks (launch.stop_when_decided); {missing} of the {planned} declared trials "
                "are not there. The verdict is that of the looks (gsbench report): p and intervals of tests that take "
                "the number of seeds as fixed are too sure."
            )
        elif missing:
            lines.append(
                f"{missing} of the {planned} declared trials are not there yet: until they are, this is a look at a "
                "part, and who ends at a look that pleases finds more than there is."
            )
        lines += [f"Before it, {one.metric} was declared ({one.when})." for one in self.earlier]
        return lines

    def _what_was_added(self) -> str:
        """``seeds 3 and 4; arm sfm-absgrad``: what none of the declared trials has."""
        planned = self.declaration.trials or {}
        scenes = {key.split("/")[0] for key in planned}
        arms = {tuple(key.split("/")[1:]) for key in planned}
        seeds = {seed for own in planned.values() for seed in own}
        news = {
            "scene": {trial.scene for trial in self.added} - scenes,
            "arm": {"-".join(trial.arm) for trial in self.added if (_arm(trial), trial.config_hash) not in arms},
            "seed": {str(trial.seed) for trial in self.added if trial.seed not in seeds},
        }
        parts = [f"{what if len(new) == 1 else what + 's'} {listed(sorted(new))}" for what, new in news.items() if new]
        return "; ".join(parts) or "further combinations of scene, arm and seed"

    def _all(self) -> str:
        return counted(self.trials, "trial")


def standing(folder: Path, trials: Sequence[TrialResult]) -> ActiveDeclaration | None:
    """The declaration that holds for the experiment in ``folder`` with these trials: the latest; None without any.

    Trials may be added to it as long as no result is there; later ones cost it its place as soon as they are done.
    """
    declared = read_declarations(folder, (trial.record.declared for trial in trials))
    if not declared:
        return None
    metric = declared[-1].metric
    others = [one for one in declared if one.metric != metric]
    since = [one for one in declared if not others or one.time > others[-1].time or one is declared[-1]]
    first_result = min((measured(trial) for trial in trials), default=math.inf)
    whole = since[0]
    for later in since[1:]:
        if later.time <= first_result:
            whole = later
    named = replace(whole, time=since[0].time)
    seen = tuple(trial for trial in trials if measured(trial) < named.time)
    if named.trials is not None:
        added = tuple(trial for trial in trials if not _is_declared(trial, named))
    else:  # the first record may be lost but for what its trials repeat: all since the next may have been added
        again = next((one.time for one in since if one.trials is not None), math.inf)
        added = tuple(trial for trial in trials if measured(trial) >= again)
    looks = bool(read_plans(folder, STOPPING))
    return ActiveDeclaration(named, seen, added, len(trials), tuple(others), looks)


def _is_declared(trial: TrialResult, declaration: Declaration) -> bool:
    """Return whether the trial is one of those declared."""
    return trial.seed in (declaration.trials or {}).get(trial_key(trial.scene, _arm(trial), trial.config_hash), ())


def _arm(trial: TrialResult) -> str:
    """The arm as its folder is called, whatever was swept."""
    return f"{trial.init}-{trial.densify}"


def measured(trial: TrialResult) -> float:
    """The Unix time at which the trial's metrics were there; of results that do not say it, that of the file."""
    moment = None if trial.record.measured is None else unix_time(trial.record.measured)
    return trial.finished if moment is None else moment
