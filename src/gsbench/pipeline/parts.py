"""The parts of a trial: the objects that its configuration describes. Errors name its keys."""

import dataclasses
import inspect
import logging
import sys
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch

from gsbench.config.trust import (
    check_permissions,
    check_program,
    check_target,
    is_external,
    load_class,
    packages_allowed_at,
)
from gsbench.densify import Densifier
from gsbench.errors import InputError
from gsbench.eval.evaluator import Evaluator
from gsbench.eval.facts import facts_of
from gsbench.eval.metric import Metric
from gsbench.eval.options import EvalConfig
from gsbench.eval.protocol import get_protocol
from gsbench.external.settings import External
from gsbench.init.base import Initializer
from gsbench.raster import EXECUTORS, Rasterizer
from gsbench.raster.executors import AUTO, lacks, resolve
from gsbench.runs.experiments import metric_and_question
from gsbench.runs.nested import GSBENCH, targets_in
from gsbench.runs.user_code import UserCode, module_digest, unnamed_modules, user_modules
from gsbench.scene.options import SceneConfig
from gsbench.settings import check_values, unknown_setting
from gsbench.system.device import select_device
from gsbench.system.resources import available_threads
from gsbench.train.options import TrainConfig
from gsbench.train.proof import Proven, create_proven
from gsbench.words import did_you_mean

log = logging.getLogger(__name__)

RESERVED = ("_target_", "name", "switches")  # keys of a group that are not options of its class
REQUIRED_METHODS = {  # of a user's class, by the group that names it
    "init": ("needs_reference", "content", "run"),
    "densify": ("prepare", "begin", "observe", "refine", "after_step"),
    "raster": ("render",),
    "eval": ("measure",),
}


class Parts:
    """The objects that the resolved configuration ``values`` describes.

    Each is made at its first use and kept. The first use raises InputError for a wrong key. It also
    runs the user's code if the class is the user's own.
    """

    def __init__(self, values: dict[str, Any]) -> None:
        # checked again, because `values` may come from a config.yaml that gsbench did not compose
        check_permissions(values)
        self.values = values
        self.seed: int = values["seed"]
        self._allowed: list[str] = values["allow_targets"]

    @cached_property
    def scene(self) -> SceneConfig:
        return SceneConfig(**self.values["scene"])

    @cached_property
    def train(self) -> TrainConfig:
        return TrainConfig(**self.values["train"])

    @cached_property
    def eval(self) -> EvalConfig:
        return EvalConfig(**self.values["eval"])

    @cached_property
    def initializer(self) -> Initializer:
        values = self.values["init"]
        # else COLMAP would take all cores
        if values.get("threads") == "auto" and values["_target_"].startswith(GSBENCH):
            values = values | {"threads": self.threads}
        initializer: Initializer = build("init", values, self._allowed)
        return initializer

    @cached_property
    def trainer(self) -> Densifier | External:
        """The trainer of the group densify: a densifier, or another program."""
        trainer: Densifier | External = build("densify", self.values["densify"], self._allowed)
        return trainer

    @property
    def program(self) -> External | None:
        """The program that trains instead of gsbench; None if gsbench trains."""
        return self.trainer if isinstance(self.trainer, External) else None

    @cached_property
    def own_rasterizer(self) -> Rasterizer | None:
        """The user's own rasterizer; None if the configuration names one of gsbench's."""
        return build_own_rasterizer(self.values["raster"], self._allowed)

    @cached_property
    def metrics(self) -> Mapping[str, Metric]:
        """The user's own metrics."""
        return build_metrics(self.values["eval"], self._allowed)

    @cached_property
    def device(self) -> torch.device:
        """The device of this machine on which the trial runs."""
        return select_device(self.values["device"])

    @cached_property
    def threads(self) -> int:
        """The CPU threads that the trial may use on this machine."""
        wanted = self.values["threads"]
        if wanted == "auto":
            return available_threads(self.values["launch"]["parallel"])
        return int(wanted)

    @cached_property
    def raster(self) -> Proven:
        """The rasterizer for ``device``, with its proof. A user's own has none."""
        chosen = None if self.own_rasterizer is None else Proven(self.own_rasterizer)
        chosen = chosen or create_proven(self.values["raster"]["name"], self.device, self.threads)
        self._check_outputs(chosen.rasterizer.name)
        return chosen

    @property
    def rasterizer(self) -> Rasterizer:
        return self.raster.rasterizer

    @cached_property
    def evaluator(self) -> Evaluator:
        """The evaluator that measures the renders. Making it looks for the weights of networks."""
        return make_evaluator(self.eval, self.device, self.metrics)

    @cached_property
    def user_code(self) -> UserCode:
        """The user's code behind the parts."""
        targets = {".".join(place): target for place, target in targets_in(self.values)}
        return UserCode(user_modules(self.values), targets)

    @property
    def measured_earlier(self) -> list[int]:
        """The iterations before the last at which the test views are measured too."""
        return sorted({step for step in self.eval.at if step < self.train.iterations})

    def check(self, on_this_machine: bool) -> None:
        """Raise InputError, naming the key, for settings that are known to fail.

        With ``on_this_machine`` the trial will run on this machine, so its devices and programs are
        checked too.
        """
        _ = self.initializer, self.trainer, self.metrics
        name, own = self.values["raster"]["name"], self.own_rasterizer
        if on_this_machine and self.program is not None:
            self.program.executable()
        if own is not None or name != AUTO:
            self._check_outputs(name if own is None else own.name)
        if on_this_machine:
            device = self.device
            if own is None and name != AUTO:
                resolve(name, device.type)

    def _check_outputs(self, raster: str) -> None:
        """Raise InputError if the densifier needs an output that ``raster`` does not give."""
        # Another program has no needs, and a user's class may not extend ``Densifier``.
        footprint = getattr(self.trainer, "needs_footprint", False)
        extra = getattr(self.trainer, "needs_extra", None)
        if lack := lacks(raster, self.own_rasterizer, footprint, extra):
            raise InputError(f"densify={self.values['densify']['name']} {lack}")


def build(group: str, values: dict[str, Any], allow_targets: list[str]) -> Any:
    """The object that ``values`` of ``group`` (init, densify, raster, eval.extra.NAME) describes.

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


def build_own_rasterizer(values: dict[str, Any], allow_targets: list[str]) -> Rasterizer | None:
    """The user's own rasterizer; None if ``values`` of the group raster name one of gsbench's."""
    if values.get("_target_") is None:
        return None
    rasterizer: Rasterizer = build("raster", values, allow_targets)
    target, name = values["_target_"], getattr(rasterizer, "name", None)
    if not isinstance(name, str) or any(name == executor.name for executor in EXECUTORS):
        raise InputError(
            f"raster._target_={target} needs an attribute name, a text that results and tables "
            f"show and that no other rasterizer has; it has {name!r}"
        )
    return rasterizer


def build_metrics(values: dict[str, Any], allow_targets: list[str]) -> dict[str, Metric]:
    """The user's own metrics that the settings ``eval`` name.

    Raises InputError for an unusable one.
    """
    metrics: dict[str, Metric] = {}
    for name, options in values.get("extra", {}).items():
        metrics[name] = build(f"eval.extra.{name}", options, allow_targets)
        primary = values.get("primary") or ""
        if facts_of(name, metrics[name]).direction == 0 and metric_and_question(primary)[0] == name:
            raise InputError(
                f"eval.primary={primary}: {options['_target_']} does not say whether more or less "
                "is better (direction), so no verdict can be about it"
            )
    return metrics


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
    raise InputError(
        f"{key} is not a setting{did_you_mean(unknown, parameters)} ({target} has: "
        f"{', '.join(parameters) or 'none'}); remove it by ~{key}, or start from another choice, "
        f"{group}=NAME"
    )


def locate(target: str, group: str, allow_targets: list[str]) -> type:
    """The class at the import path ``package.module.Class``.

    Raises InputError if ``group`` cannot use it. Warns of code whose version the results cannot
    record.
    """
    loaded_before = set(sys.modules)
    cls = load_class(target, group, allow_targets)
    required = REQUIRED_METHODS[group.partition(".")[0]]
    lacking = [method for method in required if not callable(getattr(cls, method, None))]
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


def make_evaluator(
    options: EvalConfig,
    device: torch.device | str = "cpu",
    extra: Mapping[str, Metric] = MappingProxyType({}),
) -> Evaluator:
    """The evaluator that the settings ``eval`` describe, with the user's own metrics ``extra``.

    Making it looks for the weights of networks.
    """
    weights = None if options.weights is None else Path(options.weights).expanduser()
    protocol = get_protocol(options.protocol)
    lpips, more = tuple(options.lpips), tuple(options.more)
    return Evaluator(protocol, device, lpips, options.flip, weights, options.download, extra, more)
