"""Verdicts with trials from published archives: the same claims, plan and looks, wherever the trials were run.

``gsbench export --results`` wrote the archives; their record of declared plans holds when the plan was written down and
which scenes could be tested.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsbench.claims.file import ClaimsFile
from gsbench.claims.shares import Shares, check_as_here, read_shares
from gsbench.claims.sweep import Check, Question, prepare
from gsbench.claims.verdict import Verdict
from gsbench.config.compose import Composed
from gsbench.errors import InputError
from gsbench.runs.declaration import DeclaredPlan

Fingerprint = Callable[[Composed], str | None]  # None: nobody knows it yet


@dataclass(frozen=True)
class Recheck:
    """Verdicts from archives, with the plan that they follow and all plans of claims of their experiment."""

    verdicts: tuple[Verdict, ...]
    declared: DeclaredPlan
    plans: tuple[DeclaredPlan, ...]


def recheck(file: ClaimsFile, archives: Sequence[Path], folder: Path) -> Recheck:
    """Judge the claims of ``file`` by the trials in ``archives`` alone, unpacked into the empty folder ``folder``.

    Raises InputError as `read_shares` and `with_shares` do.
    """
    shares = read_shares(archives, folder)
    check = with_shares(prepare(file, folder, lambda trial, metric: ""), shares)
    return Recheck(tuple(check.verdicts(shares.declared)), shares.declared, shares.plans)


def with_shares(check: Check, shares: Shares) -> Check:
    """The check as it was planned where the shares were made: their pairs of trials count as if they were here.

    A scene that cannot be run here is left to the shares. Raises InputError where the plan is not that of the file.
    """
    declared = shares.declared
    questions = [_as_planned(one, check.file.scenes_of(one.claim), declared) for one in check.questions]
    planned = replace(check, questions=tuple(questions))
    if planned.plan_hash != declared.hash:
        raise InputError(
            f"the archived trials were run under plan {declared.hash[:12]} ({declared.when}), and the file of claims "
            f"is of plan {planned.plan_hash[:12]}: give the file as it was then"
        )
    return replace(planned, elsewhere=lambda trial: shares.find(trial.values))


def check_can_go_on(check: Check, shares: Shares, fingerprint: Fingerprint) -> None:
    """Raise InputError where a scene of which the shares hold a part would be gone on with otherwise than it began.

    That is by other code, or with other photographs: ``fingerprint`` gives that of a trial's photographs here.
    """
    for trial in check.trials(check.questions, check.looks[-1]):
        for seed in range(check.looks[-1]):
            if (theirs := shares.find(trial.values | {"seed": seed})) is not None:
                check_as_here(theirs, trial.values, fingerprint(trial))


def _as_planned(question: Question, every: Sequence[str], declared: DeclaredPlan) -> Question:
    """The question on those of ``every`` scene that could be tested where the plan was declared, with the reasons
    given there.
    """
    tested = declared.plan.get("tested")
    kept: Mapping[str, Any] = tested if isinstance(tested, dict) else {}
    there = tuple(scene for scene in every if scene in kept.get(question.claim.id, ()))
    others = [f"{scene}: was not tested" for scene in every if scene not in there]
    reasons = declared.missing.get(question.claim.id, others) if others else ()
    return replace(question, scenes=there, missing=tuple(reasons))
