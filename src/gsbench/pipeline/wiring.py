"""The one place that wires a trial: its steps in order, from its parts.

A run builds the steps, ``--dry-run`` and ``explain --stale`` only ask for their keys.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

from gsbench.init import Sfm
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.steps.capture import capture_step, read_capture
from gsbench.pipeline.steps.evaluate import evaluate_step, measure_step
from gsbench.pipeline.steps.external import external_step
from gsbench.pipeline.steps.ground_truth import ground_truth_step
from gsbench.pipeline.steps.init import init_step
from gsbench.pipeline.steps.train import train_step
from gsbench.pipeline.steps.views import Views
from gsbench.runs.step import Step
from gsbench.runs.store import Store
from gsbench.scene.options import SceneConfig
from gsbench.scene.types import Capture

CaptureReader = Callable[[SceneConfig, Path | None], Capture]


class TrialSteps:
    """A trial before, while and after its steps are built; each step's result is found in ``store`` under its key."""

    capture: Capture  # known once `steps` is past the making of photographs
    views: Views

    def __init__(self, parts: Parts, store: Store, read: CaptureReader = read_capture) -> None:
        self.parts, self.store, self._read = parts, store, read

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
        if parts.program is not None:
            return external_step(
                self.views, parts.program, parts.train.iterations, parts.seed, parts.device, parts.threads
            )
        return train_step(
            self.views, parts.densifier, parts.rasterizer, parts.train, parts.seed, parts.device, parts.measured_earlier
        )

    def _evaluate_step(self, trained: Step) -> Step:
        parts = self.parts
        if parts.program is not None and not parts.program.leaves_model:
            return measure_step(self.views, trained, parts.evaluator, parts.eval.geometry, parts.eval.flicker)
        return evaluate_step(
            self.views,
            trained,
            parts.rasterizer,
            parts.evaluator,
            parts.train.background,
            parts.eval.maps,
            parts.device,
            parts.measured_earlier,
            made_by_program=parts.program is not None,
            geometry=parts.eval.geometry,
            flicker=parts.eval.flicker,
        )


class StepFinder:
    """Finder of the steps of trials that are in the store; reads the photographs of a scene once for all of them."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self._captures: dict[str, Capture] = {}

    def built_stages(self, parts: Parts) -> list[str]:
        """The stages of the trial with these parts whose results are there, up to the first that is not."""
        built = []
        for step in TrialSteps(parts, self.store, self._read_once).steps():
            if self.store.find(step) is None:
                break
            built.append(step.stage.name)
        return built

    def _read_once(self, options: SceneConfig, made: Path | None) -> Capture:
        key = json.dumps([asdict(options), str(made)])
        if key not in self._captures:
            self._captures[key] = read_capture(options, made)
        return self._captures[key]
