"""The parts of a trial: what its configuration describes, as objects."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import torch

from gsbench.config.trust import check_permissions, targets_in
from gsbench.densify import Densifier
from gsbench.eval.evaluator import Evaluator
from gsbench.eval.metric import Metric
from gsbench.eval.options import EvalConfig
from gsbench.external.settings import External
from gsbench.init.base import Initializer
from gsbench.pipeline.components import (
    build,
    build_metrics,
    build_own_rasterizer,
    check_offers,
    make_evaluator,
)
from gsbench.pipeline.steps.inputs import UserCode
from gsbench.raster import Rasterizer, create_rasterizer
from gsbench.raster.executors import AUTO, resolve
from gsbench.runs.code import OWN, user_modules
from gsbench.scene.options import SceneConfig
from gsbench.system.resources import available_threads
from gsbench.train.device import select_device
from gsbench.train.options import TrainConfig


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
        _ = self.initializer, self.trainer
        name, own = self.values["raster"]["name"], self.own_rasterizer
        if here and self.program is not None:
            self.program.executable()
        if own is not None or name != AUTO:
            self._check_offers(name if own is None else own.name)
        if here:
            device = self.device
            if own is None and name != AUTO:
                resolve(name, device.type)

    def complete(self) -> None:
        """Make all that the trial's run will ask for, but for the evaluator. Raises InputError naming a wrong key."""
        _ = self.initializer, self.trainer, self.scene, self.train, self.eval, self.metrics, self.rasterizer

    def _check_offers(self, raster: str) -> None:
        check_offers(self.trainer, self.values["densify"]["name"], raster, self.own_rasterizer)
