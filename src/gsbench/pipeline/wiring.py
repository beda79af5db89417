"""The one place that wires a trial: its parts, made once from the configuration, and its steps in order.

A run builds the steps, ``--dry-run`` and ``explain --stale`` only ask for their keys.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from gsbench.config.trust import check_permissions
from gsbench.densify import Densifier
from gsbench.eval.evaluator import Evaluator
from gsbench.eval.metric import Metric
from gsbench.eval.options import EvalConfig
from gsbench.external.settings import External
from gsbench.init import Sfm
from gsbench.init.base import Initializer
from gsbench.pipeline.components import (
    build,
    build_metrics,
    build_rasterizer,
    check_footprint,
    make_evaluator,
    select_device,
)
from gsbench.pipeline.steps.capture import capture_step, read_capture
from gsbench.pipeline.steps.evaluate import evaluate_step, measure_step
from gsbench.pipeline.steps.external import external_step
from gsbench.pipeline.steps.ground_truth import ground_truth_step
from gsbench.pipeline.steps.init import init_step
from gsbench.pipeline.steps.train import train_step
from gsbench.pipeline.steps.views import Views
from gsbench.raster import Rasterizer
from gsbench.runs.step import Step
from gsbench.runs.store import Store
from gsbench.scene.options import SceneConfig
from gsbench.scene.types import Capture
from gsbench.system.resources import available_threads
from gsbench.train.options import TrainConfig

CaptureReader = Callable[[SceneConfig, Path | None], Capture]


@dataclass(frozen=True)
class Parts:
    """What a trial's configuration describes, as objects."""

    scene: SceneConfig
    initializer: Initializer
    densifier: Densifier | External
    rasterizer: Rasterizer
    train: TrainConfig
    eval: EvalConfig
    metrics: Mapping[str, Metric]  # the user's own
    seed: int
    device: torch.device
    threads: int

    @classmethod
    def of(cls, values: dict[str, Any]) -> Parts:
        """The parts of the trial with the resolved configuration ``values``. Raises InputError naming a wrong key."""
        check_permissions(values)
        device = select_device(values["device"])
        threads = available_threads(values["launch"]["parallel"]) if values["threads"] == "auto" else values["threads"]
        densifier = build("densify", values["densify"], values["allow_targets"])
        rasterizer = build_rasterizer(values["raster"], values["allow_targets"], device, threads)
        check_footprint(densifier, values["densify"]["name"], rasterizer.name, rasterizer)
        return cls(
            scene=SceneConfig(**values["scene"]),
            initializer=build("init", values["init"], values["allow_targets"]),
            densifier=densifier,
            rasterizer=rasterizer,
            train=TrainConfig(**values["train"]),
            eval=EvalConfig(**values["eval"]),
            metrics=build_metrics(values["eval"], values["allow_targets"]),
            seed=values["seed"],
            device=device,
            threads=threads,
        )

    @property
    def measured_earlier(self) -> list[int]:
        """The iterations before the last at which the test views are measured as well."""
        return sorted({step for step in self.eval.at if step < self.train.iterations})


class Trial:
    """A trial before, while and after its steps are built; each step's result is found in ``store`` under its key."""

    capture: Capture  # known once `steps` is past the making of photographs
    views: Views

    def __init__(self, parts: Parts, store: Store, read: CaptureReader = read_capture) -> None:
        self.parts, self.store, self._read = parts, store, read

    @cached_property
    def evaluator(self) -> Evaluator:
        return make_evaluator(self.parts.eval, self.parts.device, self.parts.metrics)

    def steps(self) -> Iterator[Step]:
        """The steps in order. A caller that wants results builds each before it asks for the next.

        Keys chain without building, with one exception: the courtyard's photographs must be rendered before their
        fingerprint is known, so where they are not in the store, theirs is the last step.
        """
        parts, store = self.parts, self.store
        made = capture_step(parts.scene)
        if made is not None:
            yield made
            if store.find(made) is None:
                return
        self.capture = self._read(parts.scene, None if made is None else store.path(made))
        reference = None
        if parts.initializer.needs_reference(self.capture):
            reference = init_step(store, self.capture, Sfm())
            yield reference
        init = init_step(store, self.capture, parts.initializer, reference)
        yield init
        self.views = Views(store, self.capture, init, parts.scene)
        trained = self._train_step()
        yield trained
        yield ground_truth_step(self.views)
        yield self._evaluate_step(trained)

    def _train_step(self) -> Step:
        parts = self.parts
        if isinstance(parts.densifier, External):
            return external_step(
                self.views, parts.densifier, parts.train.iterations, parts.seed, parts.device, parts.threads
            )
        return train_step(
            self.views, parts.densifier, parts.rasterizer, parts.train, parts.seed, parts.device, parts.measured_earlier
        )

    def _evaluate_step(self, trained: Step) -> Step:
        parts = self.parts
        program = parts.densifier if isinstance(parts.densifier, External) else None
        if program is not None and not program.leaves_model:
            return measure_step(self.views, trained, self.evaluator, parts.eval.geometry, parts.eval.flicker)
        return evaluate_step(
            self.views,
            trained,
            parts.rasterizer,
            self.evaluator,
            parts.train.background,
            parts.eval.maps,
            parts.device,
            parts.measured_earlier,
            made_by_program=program is not None,
            geometry=parts.eval.geometry,
            flicker=parts.eval.flicker,
        )


class StepFinder:
    """Tells which steps of trials are in the store; reads the photographs of a scene once for all of them."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self._captures: dict[str, Capture] = {}

    def built_stages(self, values: dict[str, Any]) -> list[str]:
        """The stages of the trial with the configuration ``values`` whose results are there, up to the first that is
        not."""
        built = []
        for step in Trial(Parts.of(values), self.store, self._read_once).steps():
            if self.store.find(step) is None:
                break
            built.append(step.stage.name)
        return built

    def _read_once(self, options: SceneConfig, made: Path | None) -> Capture:
        key = json.dumps([asdict(options), str(made)])
        if key not in self._captures:
            self._captures[key] = read_capture(options, made)
        return self._captures[key]
