"""The parts of a trial: what its configuration describes, as objects, with errors that name the key."""

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

from gsbench.config.schema import require_values
from gsbench.config.trust import (
    check_permissions,
    check_program,
    check_target,
    homes_of,
    is_external,
    load_class,
    targets_in,
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
from gsbench.pipeline.steps.inputs import UserCode
from gsbench.raster import EXECUTORS, Rasterizer, create_rasterizer
from gsbench.raster.executors import AUTO, offers, resolve
from gsbench.runs.code import OWN, module_digest, unnamed_modules, user_modules
from gsbench.runs.declaration import metric_and_question
from gsbench.scene.options import SceneConfig
from gsbench.settings import checked, option_fields, unknown_setting
from gsbench.system.resources import available_threads
from gsbench.train.device import select_device
from gsbench.train.options import TrainConfig
from gsbench.words import closest

log = logging.getLogger(__name__)

# Offers of rasterizers beyond the contract, by the attribute with which a densifier asks; and a refusal in words.
ASKED_OF_RENDERS = {
    "needs_footprint": ("has_footprint", "needs the pixels that a Gaussian covers, and raster={} does not give them"),
    "needs_splitting_matrix": ("has_splitting_matrix", "needs splitting matrices, and raster={} does not give them"),
}
RESERVED = ("_target_", "name", "switches")  # keys of a group that are not options of its class
METHODS = {
    "init": ("needs_reference", "content", "run"),
    "densify": ("prepare", "begin", "observe", "refine", "after_step"),
    "raster": ("render",),
    "eval": ("measure",),
}


class Parts:
    """Objects that the resolved configuration ``values`` describes; each is made when it is first asked for, and kept.

    Asking for one raises InputError that names a wrong key; a part of the user's own class runs its code then.
    """

    def __init__(self, values: dict[str, Any]) -> None:
        check_permissions(values)  # whatever file they came from
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
        if values.get("threads") == "auto" and values["_target_"].startswith(OWN):  # else COLMAP takes all cores
            values = values | {"threads": self.threads}
        made: Initializer = build("init", values, self._allowed)
        return made

    @cached_property
    def trainer(self) -> Densifier | External:
        """The trainer that the group densify describes: a densifier of gsbench's own trainer, or another program."""
        made: Densifier | External = build("densify", self.values["densify"], self._allowed)
        return made

    @property
    def densifier(self) -> Densifier:
        """The densifier that edits the Gaussians where gsbench trains."""
        assert isinstance(self.trainer, Densifier)
        return self.trainer

    @property
    def program(self) -> External | None:
        """The other program that trains, if one does."""
        return self.trainer if isinstance(self.trainer, External) else None

    @cached_property
    def own_rasterizer(self) -> Rasterizer | None:
        """The rasterizer where it is a class of the user's own; None where it goes by a name."""
        return build_own_rasterizer(self.values["raster"], self._allowed)

    @cached_property
    def metrics(self) -> Mapping[str, Metric]:
        """The user's own metrics."""
        return build_metrics(self.values["eval"], self._allowed)

    @cached_property
    def device(self) -> torch.device:
        """The device of this machine that the trial runs on."""
        return select_device(self.values["device"])

    @cached_property
    def threads(self) -> int:
        """The CPU threads that the trial may use on this machine."""
        wanted = self.values["threads"]
        return available_threads(self.values["launch"]["parallel"]) if wanted == "auto" else int(wanted)

    @cached_property
    def rasterizer(self) -> Rasterizer:
        """The rasterizer for ``device``."""
        made = self.own_rasterizer
        if made is None:
            made = create_rasterizer(self.values["raster"]["name"], self.device, self.threads)
        self._check_offers(made.name)
        return made

    @cached_property
    def evaluator(self) -> Evaluator:
        """The evaluator that measures the renders; looks for the weights of networks."""
        return make_evaluator(self.eval, self.device, self.metrics)

    @cached_property
    def user_code(self) -> UserCode:
        """The user's code behind the parts."""
        targets = {".".join(place): target for place, target in targets_in(self.values)}
        return UserCode(user_modules(self.values), targets)

    @property
    def measured_earlier(self) -> list[int]:
        """The iterations before the last at which the test views are measured as well."""
        return sorted({step for step in self.eval.at if step < self.train.iterations})

    def check(self, here: bool) -> None:
        """Refuse before any work what is known to fail; what was made for it stays.

        With ``here``, the trial will run on this machine, whose devices are known. Raises InputError naming the key.
        """
        _ = self.initializer, self.trainer, self.metrics
        name, own = self.values["raster"]["name"], self.own_rasterizer
        if here and self.program is not None:
            self.program.executable()
        if own is not None or name != AUTO:
            self._check_offers(name if own is None else own.name)
        if here:
            device = self.device
            if own is None and name != AUTO:
                resolve(name, device.type)

    def _check_offers(self, raster: str) -> None:
        check_offers(self.trainer, self.values["densify"]["name"], raster, self.own_rasterizer)


def build(group: str, values: dict[str, Any], allow_targets: list[str]) -> Any:
    """The object that ``values`` of ``group`` (init, densify, raster, eval.extra.NAME) describes.

    ``_target_`` names a class by its import path; the other keys are its arguments. gsbench's own classes hold them
    against their annotations themselves; for a user's dataclass this is done here, before its code sees them. Raises
    InputError naming the key that is unknown or wrong.
    """
    target = values["_target_"]
    for place, named in targets_in(values, tuple(group.split("."))):
        check_target(named, ".".join(place), allow_targets, homes_of(place))
    external = group == "densify" and is_external(values)
    if external:
        check_program(values, allow_targets)
    cls = External if external else locate(target, group, allow_targets)
    require_values(values, group)
    options = {key: value for key, value in values.items() if key not in RESERVED}
    own = target.startswith(OWN)
    if dataclasses.is_dataclass(cls) and not own:
        _check_fields(cls, target, options, group)
        options = checked(cls, options, group)
    else:
        _check_names(cls, options, group)
        if options and not own:
            raise InputError(
                f"{group}._target_={target} has options but is not a dataclass: make it one, so that results are "
                "stored under their values"
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
        raise InputError(f"{group}: {target} cannot be made ({type(error).__name__}: {error})") from error


def _check_fields(cls: type, target: str, options: dict[str, Any], group: str) -> None:
    """Raise InputError for a setting that the user's class lacks, mostly one of the choice that it started from."""
    known = [field.name for field in option_fields(cls)]
    if strange := next((name for name in options if name not in known), None):
        key = f"{group}.{strange}"
        raise InputError(
            f"{key} is not a setting{closest(strange, known)} ({target} has: {', '.join(known) or 'none'}); remove it "
            f"by ~{key}, or start from another choice, {group}=NAME"
        )


def build_rasterizer(
    values: dict[str, Any], allow_targets: list[str], device: torch.device, threads: int | None = None
) -> Rasterizer:
    """The rasterizer that ``values`` of the group raster describes: a class of the user's own, or one by name.

    Raises InputError where it cannot run on ``device``.
    """
    own = build_own_rasterizer(values, allow_targets)
    return create_rasterizer(values["name"], device, threads) if own is None else own


def build_own_rasterizer(values: dict[str, Any], allow_targets: list[str]) -> Rasterizer | None:
    """The user's own rasterizer; None where ``values`` of the group raster name one of gsbench's."""
    if values.get("_target_") is None:
        return None
    rasterizer: Rasterizer = build("raster", values, allow_targets)
    target, name = values["_target_"], getattr(rasterizer, "name", None)
    if not isinstance(name, str) or any(name == executor.name for executor in EXECUTORS):
        raise InputError(
            f"raster._target_={target} needs an attribute name, a text that results and tables show and that no other "
            f"rasterizer has; it has {name!r}"
        )
    return rasterizer


def check_offers(densifier: Any, arm: str, raster: str, own: Any = None) -> None:
    """Raise InputError where densify=``arm`` asks a render for something that raster=``raster`` does not give.

    ``own`` is the rasterizer if it is a user's.
    """
    for asked, (offer, words) in ASKED_OF_RENDERS.items():
        if getattr(densifier, asked, False) and not offers(raster, offer, own):
            able = " or ".join(f"raster={executor.name}" for executor in EXECUTORS if getattr(executor, offer))
            raise InputError(f"densify={arm} {words.format(raster)}; take {able}")


def build_metrics(values: dict[str, Any], allow_targets: list[str]) -> dict[str, Metric]:
    """The user's own metrics that the settings ``eval`` name. Raises InputError for one that cannot be used."""
    metrics: dict[str, Metric] = {}
    for name, options in values.get("extra", {}).items():
        metrics[name] = build(f"eval.extra.{name}", options, allow_targets)
        primary = values.get("primary") or ""
        if facts_of(name, metrics[name]).direction == 0 and metric_and_question(primary)[0] == name:
            raise InputError(
                f"eval.primary={primary}: {options['_target_']} does not say whether more or less is better "
                "(direction), so no verdict can be about it"
            )
    return metrics


def _check_names(cls: Any, options: dict[str, Any], group: str) -> None:
    """Raise InputError for an option that the constructor of ``cls`` does not take."""
    parameters = inspect.signature(cls).parameters
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values()):
        return
    for key in options:
        if key not in parameters:
            raise InputError(unknown_setting(f"{group}.{key}", key, parameters))


def locate(target: str, group: str, allow_targets: list[str]) -> type:
    """The class at the import path ``package.module.Class``, which must be one that ``group`` can use."""
    before = set(sys.modules)
    found = load_class(target, group, allow_targets)
    lacking = [method for method in METHODS[group.partition(".")[0]] if not callable(getattr(found, method, None))]
    if not isinstance(found, type) or lacking:
        without = f": it has no {', '.join(lacking)}()" if lacking else ""
        raise InputError(f"{group}._target_={target} is not a class for {group}{without}")
    if target.startswith(OWN):
        return found
    module, named = target.split(".")[0], {name.split(".")[0] for name in allow_targets}
    if module_digest(module) is None:  # the first call notes the files as they are, while they are what runs
        log.warning("no file of %s was found: results do not record its version", target)
    if unnamed := unnamed_modules(before, {module, *named}):
        words = ", ".join(unnamed)
        log.warning(
            "%s imports %s, and results do not record their versions: name them in allow_targets too", target, words
        )
    return found


def make_evaluator(
    options: EvalConfig, device: torch.device | str = "cpu", extra: Mapping[str, Metric] = MappingProxyType({})
) -> Evaluator:
    """The evaluator that the settings ``eval`` describe, with the user's own metrics; looks for networks' weights."""
    weights = None if options.weights is None else Path(options.weights).expanduser()
    protocol = get_protocol(options.protocol)
    lpips, more = tuple(options.lpips), tuple(options.more)
    return Evaluator(protocol, device, lpips, options.flip, weights, options.download, extra, more)
