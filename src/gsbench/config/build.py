"""Making the object that a configuration describes: a class of gsbench's, or of the user's.

Loads neither torch nor Hydra by itself.
"""

from __future__ import annotations

import dataclasses
import inspect
import logging
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from gsbench.config.groups import GROUPS, REMOVABLE
from gsbench.config.trust import (
    check_program,
    check_target,
    is_external,
    load_class,
    packages_allowed_at,
)
from gsbench.errors import InputError
from gsbench.eval.facts import MetricFacts, facts_of, find_metric, in_region
from gsbench.external.settings import External
from gsbench.runs.code import module_digest, unnamed_modules
from gsbench.runs.configuration import GSBENCH, targets_in
from gsbench.runs.experiments import AT, metric_and_question
from gsbench.settings import check_values, unknown_setting
from gsbench.words import did_you_mean

if TYPE_CHECKING:
    from gsbench.eval.metric import Metric

log = logging.getLogger(__name__)

RESERVED = ("_target_", "name", "switches")  # keys of a group that are not options of its class
REQUIRED_METHODS = {  # of a user's class, by the group or the setting that names it
    "init": ("needs_reference", "content", "run"),
    "densify": ("prepare", "begin", "observe", "refine", "after_step"),
    "raster": ("render",),
    "eval": ("measure",),
    "scene": ("read",),
    "train.loss": ("__call__",),
    "train.terms": ("__call__",),
    "train.schedule": ("__call__",),
    "train.optimizer": ("init", "step"),
    "tracking": ("open", "send"),
}


def build(group: str, values: dict[str, Any], allow_targets: list[str]) -> Any:
    """The object that ``values`` of ``group`` (``init``, ``eval.extra.NAME``, …) describes.

    ``_target_`` names a class by its import path; the other keys are its arguments. gsbench's own
    classes check them against their annotations. For a user's dataclass this is done here, before
    its code sees them. Raises InputError naming the key that is unknown or wrong.
    """
    target = values["_target_"]
    for place, nested_target in targets_in(values, tuple(group.split("."))):
        check_target(nested_target, ".".join(place), allow_targets, packages_allowed_at(place))
    external = group == "densify" and is_external(values)
    if external:
        check_program(values, allow_targets)
    cls = External if external else locate(target, group, allow_targets)
    options = {key: value for key, value in values.items() if key not in RESERVED}
    own = target.startswith(GSBENCH)
    _check_names(cls, target, options, group)
    if dataclasses.is_dataclass(cls) and not own:
        options = check_values(cls, options, group)
    elif options and not own:
        raise InputError(
            f"{group}._target_={target} has options but is not a dataclass: make it one, so that "
            "results are stored under their values"
        )
    try:
        return cls(**options)
    except InputError:
        raise
    except (TypeError, ValueError) as error:
        raise InputError(f"{group}: {error}") from error
    except (Exception, SystemExit) as error:  # a user's class may raise anything
        if own:
            raise
        raise InputError(
            f"{group}: {target} cannot be made ({type(error).__name__}: {error})"
        ) from error


def _check_names(cls: Any, target: str, options: dict[str, Any], group: str) -> None:
    """Raise InputError for an option that the constructor of ``cls`` does not take.

    If a user's class lacks an option, it usually belongs to the choice (``densify=adc``) whose
    class the user replaced.
    """
    parameters = inspect.signature(cls).parameters
    unknown = next((name for name in options if name not in parameters), None)
    if unknown is None or any(
        parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()
    ):
        return
    key = f"{group}.{unknown}"
    if target.startswith(GSBENCH):
        raise InputError(unknown_setting(key, unknown, parameters))
    known, advice = [*parameters], ""
    if group.startswith("train.terms."):
        known.append("weight")  # of every term
    if group in GROUPS:
        remove = f"remove it by ~{key}, or " if group in REMOVABLE else ""
        advice = f"; {remove}start from another choice, {group}=NAME"
    raise InputError(
        f"{key} is not a setting{did_you_mean(unknown, known)} ({target} has: "
        f"{', '.join(known) or 'none'}){advice}"
    )


def locate(target: str, group: str, allow_targets: list[str]) -> type:
    """The class at the import path ``package.module.Class``.

    Raises InputError if ``group`` cannot use it. Warns of code whose version the results cannot
    record.
    """
    loaded_before = set(sys.modules)
    cls = load_class(target, group, allow_targets)
    required = next(
        methods
        for place, methods in REQUIRED_METHODS.items()
        if group == place or group.startswith(f"{place}.")
    )
    # A class itself can always be called: only its own ``__call__`` counts.
    defined = {name for base in getattr(cls, "__mro__", ()) for name in vars(base)}
    lacking = [method for method in required if method not in defined]
    if not isinstance(cls, type) or lacking:
        without = f": it has no {', '.join(lacking)}()" if lacking else ""
        raise InputError(f"{group}._target_={target} is not a class for {group}{without}")
    if target.startswith(GSBENCH):
        return cls
    module, permitted = target.split(".")[0], {name.split(".")[0] for name in allow_targets}
    # The first call keeps the digest of the files. It must come right after the import: later they
    # may be edited, and the digest would be of code that does not run.
    if module_digest(module) is None:
        log.warning("no file of %s was found: results do not record its version", target)
    if unnamed := unnamed_modules(loaded_before, {module, *permitted}):
        log.warning(
            "%s imports %s, and results do not record their versions: name them in allow_targets "
            "too",
            target,
            ", ".join(unnamed),
        )
    return cls


# ---- metrics


def build_metrics(values: dict[str, Any], allow_targets: list[str]) -> dict[str, Metric]:
    """The user's own metrics that the settings ``eval`` name.

    Raises InputError for an unusable one.
    """
    metrics: dict[str, Metric] = {}
    for name, options in values.get("extra", {}).items():
        metrics[name] = build(f"eval.extra.{name}", options, allow_targets)
        primary = values.get("primary") or ""
        asked = metric_and_question(primary)[0].partition(AT)[0]
        if facts_of(name, metrics[name]).direction == 0 and asked == name:
            raise InputError(
                f"eval.primary={primary}: {options['_target_']} does not say whether more or less "
                "is better (direction), so no verdict can be about it"
            )
    return metrics


def facts_for(metric: str, values: Mapping[str, Any]) -> MetricFacts:
    """The facts of a metric, gsbench's or the user's own, of trials with the configuration.

    Raises InputError for an unknown metric.
    """
    if (shipped := find_metric(metric)) is not None:
        return shipped
    name, _, region = metric.partition(AT)
    metrics = build_metrics(values["eval"], values["allow_targets"])
    return in_region(facts_of(name, metrics[name]), region)
