"""The one place that wires a trial: its steps in order, from its parts."""

from __future__ import annotations

from collections.abc import Iterator

from gsbench.init import Sfm
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.steps.evaluate import evaluate_step
from gsbench.pipeline.steps.external import external_step
from gsbench.pipeline.steps.init import init_step
from gsbench.pipeline.steps.scene import CaptureSource, Views, ground_truth_step, masked, masked_step
from gsbench.pipeline.steps.train import train_step
from gsbench.runs.stages import Step
from gsbench.runs.store import Store
from gsbench.scene.types import Capture


class TrialSteps:
    """A trial before, while and after its steps are built; each step's result is found in ``store`` under its key."""

    photographs: Capture  # the user's photographs; known, as the next, once `steps` is past the making of photographs
    capture: Capture  # what the steps look at: without what masks ignore
    views: Views

    def __init__(self, parts: Parts, store: Store) -> None:
        self.parts, self.store = parts, store

    def steps(self) -> Iterator[Step]:
        """The steps in order. A caller that wants results builds each before it asks for the next.

        Keys chain without building, with one exception: the courtyard's photographs must be rendered before their
        fingerprint is known, so where they are not in the store, theirs is the last step.
        """
        parts, store = self.parts, self.store
        source = CaptureSource(parts.scene)
        made = source.step
        if made is not None:
            yield made
            if store.find(made) is None:
                return
        self.capture = self.photographs = source.read(None if made is None else store.path(made))
        replaced = masked_step(self.photographs, parts.scene.transparent)
        if replaced is not None:
            yield replaced
            self.capture = masked(self.photographs, store.path(replaced))
        reference = None
        if parts.initializer.needs_reference(self.capture):
            reference = init_step(store, self.capture, Sfm(threads=parts.threads))
            yield reference
        init = init_step(store, self.capture, parts.initializer, reference, parts.user_code)
        yield init
        self.views = Views(store, self.capture, init, parts.scene)
        program = parts.program
        trained = train_step(self.views, parts) if program is None else external_step(self.views, program, parts)
        yield trained
        yield ground_truth_step(self.views)
        yield evaluate_step(self.views, trained, parts)
