"""Verdicts with trials from published archives: the same claims, plan and looks, wherever the trials were run.

``gsbench export --results`` wrote the archives; their record of declared plans holds when the plan was written down and
which scenes could be tested.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gsbench.claims.file import ClaimsFile
from gsbench.claims.shares import (
    FindTrial,
    Shares,
    check_alike,
    check_code,
    check_photographs,
    read_shares,
    tested,
)
from gsbench.claims.sweep import Check, Find, Question, prepare
from gsbench.claims.verdict import Verdict
from gsbench.config.compose import TrialConfig
from gsbench.errors import InputError
from gsbench.runs.declaration import DeclaredPlan

Fingerprint = Callable[[TrialConfig], str | None]  # None: nobody knows it yet


@dataclass(frozen=True)
class Recheck:
    """Verdicts from archives, with the plan that they follow and all plans of claims of their experiment."""

    verdicts: tuple[Verdict, ...]
    declared: DeclaredPlan
    plans: tuple[DeclaredPlan, ...]


def recheck(file: ClaimsFile, archives: Sequence[Path], folder: Path, permissions: Sequence[str] = ()) -> Recheck:
    """Judge the claims of ``file`` by the trials in ``archives`` alone, unpacked into the empty folder ``folder``.

    ``permissions`` are those of `prepare`. Raises InputError as `read_shares`, `with_shares` and `judged` do.
    """
    shares = read_shares(archives, folder, file.name)
    check = with_shares(prepare(file, folder, lambda trial, metric: "", permissions), shares)
    return Recheck(judged(check.verdicts(shares.declared)), shares.declared, shares.plans)


def judged(verdicts: Sequence[Verdict]) -> tuple[Verdict, ...]:
    """The verdicts, whose trials are all alike. Raises InputError where code or photographs are not."""
    check_alike(list({trial.path: trial for verdict in verdicts for trial in verdict.trials}.values()))
    return tuple(verdicts)


def with_shares(check: Check, shares: Shares) -> Check:
    """The check as it was planned where the shares were made: their pairs of trials count as if they were here.

    A scene that cannot be run here is left to the shares. Raises InputError where the plan is not that of the file, and
    where they hold no trial of it.
    """
    declared = shares.declared
    questions = [_as_planned(one, check.file.scenes_of(one.claim), declared) for one in check.questions]
    planned = replace(check, questions=tuple(questions))
    if planned.plan_hash != declared.hash:
        raise InputError(
            f"the archived trials were run under plan {declared.hash[:12]} ({declared.when}), and the file of claims "
            f"is of plan {planned.plan_hash[:12]}: give the file as it was then"
        )
    sources = tuple((name, _by_values(find)) for name, find in shares.sources)
    for name, find in sources:
        if not any(find(trial) is not None for _, _, trial in planned.planned()):
            raise InputError(
                f"{name} holds no trial of this plan: its settings are of another version of gsbench; check out the "
                "commit that made it"
            )
    return replace(planned, elsewhere=sources)


def _by_values(find: FindTrial) -> Find:
    return lambda trial: find(trial.values)


def check_can_go_on(check: Check, fingerprint: Fingerprint) -> None:
    """Raise InputError where a check would be gone on with otherwise than it began.

    That is by other code than that of shares, and of scenes that are not run here now; or, of a scene of which shares
    hold a part, with other photographs: ``fingerprint`` gives that of a trial's photographs here.
    """
    if not check.elsewhere and check.is_all_here:
        return
    to_run = check.trials(check.questions, check.looks[-1])
    if not to_run:
        return
    scenes = {trial.values["scene"]["name"] for trial in to_run}
    here = check.find_here()
    for claim, scene, trial in check.planned():
        found = [theirs for _, find in check.elsewhere if (theirs := find(trial)) is not None]
        if trial.values["scene"]["name"] in scenes and (claim, scene) in check.run_here:
            for theirs in found:
                check_photographs(theirs, fingerprint(trial))
        elif (ours := here(trial)) is not None:
            found.append(ours)
        for one in found:
            check_code(one, trial.values)


def _as_planned(question: Question, every: Sequence[str], declared: DeclaredPlan) -> Question:
    """The question on those of ``every`` scene that could be tested where the plan was declared, with the reasons
    given there.
    """
    kept = tested(declared)
    there = tuple(scene for scene in every if (question.claim.id, scene) in kept)
    others = [f"{scene}: was not tested" for scene in every if scene not in there]
    reasons = declared.missing.get(question.claim.id, others) if others else ()
    return replace(question, scenes=there, missing=tuple(reasons))
