"""Reading the plans of claims that earlier versions published: which of an archive's trials each claim was about.

Such a plan names settings, not folders. A trial is told by the settings that the plan names, so that a default which
was added or changed since leaves a published archive readable.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from gsbench.analysis.results import TrialResult, by_key
from gsbench.claims.file import DIRECTIONS, read_least
from gsbench.errors import InputError
from gsbench.runs.declaration import Arm, Declaration, Question

PATHS = ("scene.path", "init.path")  # where somebody's files lay


def resolve(declaration: Declaration, trials: Sequence[TrialResult]) -> Declaration:
    """The declaration with the questions of its published plan, if it has one, about ``trials``.

    Raises InputError for a plan that is damaged, and where the settings that it names do not tell trials apart.
    """
    if not declaration.plan:
        return declaration
    plan = declaration.plan
    kinds = {key: own[0] for key, own in by_key(trials, lambda trial: trial.key).items()}
    try:
        questions = [_question(claim, plan, kinds) for claim in plan["claims"]]
        return replace(
            declaration,
            questions=tuple(one for one in questions if one.scenes),
            error_rate=float(plan["error_rate"]),
            looks=tuple(plan["looks"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"the plan of claims that was declared {declaration.when} is damaged ({error!r})") from None


def _question(claim: Mapping[str, Any], plan: Mapping[str, Any], kinds: Mapping[str, TrialResult]) -> Question:
    least = read_least(claim["least"], f"claim {claim['id']}")
    arms = [
        Arm("", name, tuple((key, str(value)) for key, value in plan["arms"][name].items())) for name in _arms(claim)
    ]
    scenes = {}
    for scene in plan["tested"].get(claim["id"], ()):
        both = [_folder(dict(_chosen(claim, plan, scene, arm)), plan, kinds) for arm in _arms(claim)]
        if all(both):
            scenes[scene] = both[0], both[1]
    return Question(
        metric=claim["metric"],
        sign=DIRECTIONS[claim["direction"]],
        least=least.size,
        relative=least.relative,
        baseline=arms[0],
        arm=arms[1],
        scenes=scenes,
        seeds=tuple(range(max(plan["looks"]))),
        name=claim["id"],
    )


def _arms(claim: Mapping[str, Any]) -> tuple[str, str]:
    return claim["baseline"], claim["arm"]


def _chosen(claim: Mapping[str, Any], plan: Mapping[str, Any], scene: str, arm: str) -> Iterator[tuple[str, Any]]:
    """The settings of the claim's trials; of one that is given twice the later counts."""
    for group in (plan["settings"], plan["scenes"][scene], plan["arms"][arm], claim["split"], claim["budget"]):
        for key, value in group.items():
            yield key.lstrip("+"), value


def _folder(chosen: Mapping[str, Any], plan: Mapping[str, Any], kinds: Mapping[str, TrialResult]) -> str:
    """The folder of the trials with the ``chosen`` settings; "" where there is none."""
    named = {
        "scene": chosen.get("scene.name", chosen.get("scene")),
        "init": chosen.get("init.name", chosen.get("init")),
        "densify": chosen.get("densify.name", chosen.get("densify")),
    }
    given = {name: value for name, value in chosen.items() if name not in PATHS}
    found = [
        key
        for key, trial in kinds.items()
        if all(value in (None, getattr(trial, group)) for group, value in named.items())
        and all(trial.config.get(name) == value for name, value in given.items() if name in trial.config)
    ]
    if len(found) > 1:  # what others name and these trials do not, they do not have
        others = dict(_others(chosen, plan))
        found = [key for key in found if all(kinds[key].config.get(name) != others[name] for name in others)]
    if len(found) > 1:
        raise InputError(f"the settings of the declared plan do not tell {' and '.join(found)} apart")
    return found[0] if found else ""


def _others(chosen: Mapping[str, Any], plan: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """The settings that other claims, arms and scenes name and these trials do not."""
    claims = [claim[group] for claim in plan["claims"] for group in ("split", "budget")]
    for group in (*plan["scenes"].values(), *plan["arms"].values(), *claims):
        for key, value in group.items():
            name = key.lstrip("+")
            if "." in name and name not in chosen and name not in PATHS:
                yield name, value
