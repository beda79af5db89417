"""The parts of a trial: the objects that its configuration describes. Errors name its keys."""

from collections.abc import Mapping
from dataclasses import fields
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch

from gsbench.config.build import build, build_metrics
from gsbench.config.trust import check_permissions
from gsbench.densify import Densifier
from gsbench.errors import InputError
from gsbench.eval.evaluator import Evaluator
from gsbench.eval.metric import Metric
from gsbench.eval.options import EvalConfig
from gsbench.eval.protocol import get_protocol
from gsbench.external.settings import External
from gsbench.init.base import Initializer
from gsbench.raster import EXECUTORS, Rasterizer
from gsbench.raster.executors import AUTO, lacks, resolve
from gsbench.runs.code import UserCode, user_modules
from gsbench.runs.configuration import GSBENCH, TARGET, targets_in
from gsbench.scene.options import SceneConfig
from gsbench.scene.record import SceneReader
from gsbench.system.resources import available_threads, select_device
from gsbench.train.ideas import Ideas, weighted
from gsbench.train.options import TrainConfig
from gsbench.train.proof import Proven, create_proven


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
        values, known = self.values["scene"], {entry.name for entry in fields(SceneConfig)}
        return SceneConfig(**{key: value for key, value in values.items() if key in known})

    @cached_property
    def reader(self) -> SceneReader | None:
        """The user's own reader of the capture; None for gsbench's own readers."""
        known = {entry.name for entry in fields(SceneConfig)} - {TARGET}
        values = {key: value for key, value in self.values["scene"].items() if key not in known}
        return build("scene", values, self._allowed) if values.get(TARGET) else None

    @cached_property
    def train(self) -> TrainConfig:
        return TrainConfig(**self.values["train"])

    @cached_property
    def ideas(self) -> Ideas:
        """The user's classes for loss, terms, schedule and optimiser."""
        return build_ideas(self.train, self._allowed)

    @cached_property
    def eval(self) -> EvalConfig:
        return EvalConfig(**self.values["eval"])

    @cached_property
    def initializer(self) -> Initializer:
        values = self.values["init"]
        # else COLMAP would take all cores
        if values.get("threads") == "auto" and values["_target_"].startswith(GSBENCH):
            values = values | {"threads": self.threads}
        return build("init", values, self._allowed)

    @cached_property
    def trainer(self) -> Densifier | External:
        """The trainer of the group densify: a densifier, or another program."""
        return build("densify", self.values["densify"], self._allowed)

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
        # Its contract is the user's to test (docs/rasterizer.md): a proof compares gsbench's own.
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
        _ = self.reader, self.initializer, self.trainer, self.metrics, self.ideas
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


def build_ideas(options: TrainConfig, allow_targets: list[str]) -> Ideas:
    """The classes that the settings ``train`` name, beside the weights of terms."""
    single = {
        name: build(f"train.{name}", {TARGET: None} | values, allow_targets)
        for name in ("loss", "schedule", "optimizer")
        if (values := getattr(options, name))
    }
    terms = []
    for number, values in enumerate(options.terms):
        place = f"train.terms.{number}"
        weight = values.get("weight", 1.0)
        if isinstance(weight, bool) or not isinstance(weight, int | float):
            raise InputError(f"{place}.weight must be a number, got {weight!r}")
        own = {key: value for key, value in values.items() if key != "weight"}
        terms.append((build(place, {TARGET: None} | own, allow_targets), float(weight)))
    return Ideas(terms=weighted(terms), **single)


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
