"""Verdicts made again from a published archive: the same claims, plan and looks, without photographs or training.

``gsbench export --results`` wrote the archive; its record of declared plans holds when the plan was written down and
which scenes could be tested. Trials are found by their settings, since folders differ from machine to machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any

from gsbench.analysis.results import Experiment, TrialResult
from gsbench.claims.archive import read_configuration, unpack_archive
from gsbench.claims.file import ClaimsFile
from gsbench.claims.sweep import Check, Question, prepare
from gsbench.claims.verdict import Verdict
from gsbench.errors import InputError
from gsbench.runs.declaration import DeclaredPlan, read_plans
from gsbench.runs.hashing import determining, sha256_of

PATHS = ("scene", "init")  # groups whose ``path`` says where somebody's files lie


@dataclass(frozen=True)
class Recheck:
    """Verdicts from an archive, with the plan that they follow and all plans of claims of its experiment."""

    verdicts: tuple[Verdict, ...]
    declared: DeclaredPlan
    plans: tuple[DeclaredPlan, ...]


def recheck(file: ClaimsFile, archive: Path, folder: Path) -> Recheck:
    """Judge the claims of ``file`` by the trials in ``archive``, which is unpacked into the empty folder ``folder``.

    Raises InputError for an archive that is damaged, holds no declared plan, or whose plan is not that of the file.
    """
    experiment = unpack_archive(archive, folder)
    plans = [plan for plan in read_plans(experiment.folder) if not plan.kind]
    if not plans:
        raise InputError(f"{archive}: no plan of claims was declared in it: it is no archive of a gsbench check")
    declared = plans[-1]
    check = _as_planned(prepare(file, folder, lambda trial, metric: ""), declared)
    if check.plan_hash != declared.hash:
        raise InputError(
            f"{archive}: its trials were run under plan {declared.hash[:12]} ({declared.when}), and the file of claims "
            f"is of plan {check.plan_hash[:12]}: give the file as it was then"
        )
    trials = _by_settings(experiment)
    verdicts = check.verdicts(declared, lambda trial: trials.get(_identity(trial.values)))
    return Recheck(tuple(verdicts), declared, tuple(plans))


def _as_planned(check: Check, declared: DeclaredPlan) -> Check:
    """The same check on the scenes that could be tested where the plan was declared, with the reasons given there."""
    tested = declared.plan.get("tested")
    kept: Mapping[str, Any] = tested if isinstance(tested, dict) else {}

    def planned(question: Question) -> Question:
        there = tuple(scene for scene in question.scenes if scene in kept.get(question.claim.id, ()))
        others = [f"{scene}: was not tested" for scene in question.scenes if scene not in there]
        reasons = declared.missing.get(question.claim.id, others) if others else ()
        return replace(question, scenes=there, missing=tuple(reasons))

    return replace(check, questions=tuple(map(planned, check.questions)))


def _by_settings(experiment: Experiment) -> dict[str, TrialResult]:
    return {_identity(read_configuration(trial)): trial for trial in experiment.trials}


def _identity(values: Mapping[str, Any]) -> str:
    """Return the hash of a trial's seed and of the settings of its result, the same on any machine."""
    kept = determining(values)
    for group in PATHS:
        if isinstance(kept.get(group), dict) and kept[group].get("path"):
            kept[group] = kept[group] | {"path": PurePath(str(kept[group]["path"])).name}
    return sha256_of([values["seed"], kept])
