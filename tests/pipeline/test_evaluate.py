"""What an evaluation depends on: its key must not change for a setting that changes nothing."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gsbench.eval.evaluator import Evaluator
from gsbench.eval.protocol import PAPER
from gsbench.pipeline.steps import inputs as inputs_module
from gsbench.pipeline.steps.evaluate import evaluate_step, measure_speed
from gsbench.pipeline.steps.inputs import UserCode
from gsbench.raster import create_rasterizer
from gsbench.raster.contract import CASES
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.runs.stages import TRAIN, Step
from gsbench.scene.types import Scene, View

TRAINED = Step(TRAIN, {}, lambda folder: None)
FOUR_LPIPS = ["lpips_alex", "lpips_squeeze", "lpips_vgg", "lpips_vgg_raw"]


def inputs(fps: list[int] | None = None, **options: Any) -> dict[str, Any]:
    """The inputs of an evaluation without LPIPS, whose views are not needed for a key."""
    evaluator = Evaluator(PAPER, lpips=[], **options)
    cpu = torch.device("cpu")
    parts: Any = SimpleNamespace(
        evaluator=evaluator,
        rasterizer=create_rasterizer("reference", cpu, 1),
        device=cpu,
        train=SimpleNamespace(background=(0, 0, 0)),
        eval=SimpleNamespace(maps=False, fps=fps),
        measured_earlier=[],
        user_code=UserCode(),
        program=None,
    )
    step = evaluate_step(None, TRAINED, parts)  # type: ignore[arg-type]
    parts.program = SimpleNamespace(leaves_model=False)
    measured = evaluate_step(None, TRAINED, parts)  # type: ignore[arg-type]
    new = {"more", "fps"}
    assert {key: measured.inputs[key] for key in new & measured.inputs.keys()} == {
        key: step.inputs[key] for key in new & step.inputs.keys()
    }
    return dict(step.inputs)


def test_an_evaluation_that_asks_for_nothing_new_has_the_key_that_it_had(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inputs_module, "edited", lambda files: {})  # as in a release
    old = {"train": TRAINED.key, "protocol": "paper-1", "unavailable": FOUR_LPIPS, "maps": False}
    assert inputs() == old
    assert inputs([640, 480]) == old | {"fps": [640, 480]}
    assert inputs(more=["gmsd", "fsim"]) == old | {"more": ["fsim", "gmsd"]} == inputs(more=["fsim", "gmsd"])


def test_speed_is_measured_at_the_size_that_is_asked_for() -> None:
    case, sizes = CASES[-1], []

    class Watched(ReferenceRasterizer):
        def render(self, gaussians: Any, camera: Any, *rest: Any) -> Any:
            sizes.append((camera.width, camera.height))
            return super().render(gaussians, camera, *rest)

    scene = Scene("made", (), (View("a", case.camera(), np.zeros((case.height, case.width, 3), np.uint8)),))
    found = measure_speed(Watched(), case.gaussians(), scene, torch.zeros(3, dtype=torch.float64), [64, 20])
    assert set(sizes) == {(64, 20)}
    assert found["a"] > 0
