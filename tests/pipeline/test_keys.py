"""Under which keys the results of one known trial lie in the store: a key that moves throws stored results away."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsbench.config.compose import compose_one
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.steps import init as init_module
from gsbench.pipeline.steps import inputs as inputs_module
from gsbench.pipeline.steps.scene import CaptureSource
from gsbench.pipeline.wiring import TrialSteps
from gsbench.runs.hashing import config_hash
from gsbench.runs.store import Store
from gsbench.scene.types import Capture

WORDS = [
    "scene=garden", "scene.path=photos", "init=random", "densify=volumetric", "densify.volume_threshold=0.05",
    "eval.lpips=[]", "eval.flip=false", "raster=cpu", "device=cpu", "threads=1", "seed=3",
]  # fmt: skip
BARE = Capture("garden", Path("photos"), ("a.jpg", "b.jpg", "c.jpg"), ("a.jpg",), None, False, "0" * 64)
KEYS = [
    ("config", "84cbf20c22697c9af1c644d018f019b5237a03fca6c07628d0d2d71de76e239a"),
    ("init", "33343fcdd1b72fb6244c22140544aa03499aca7308e443aa21bb34b9c1f59ccb"),  # of the cameras
    ("init", "dfc40b276cecc590ed3121da6e3f42f79ac9437779bd78a389b2ca0aa76ea26a"),
    ("train", "d75cc1f576b45bcf7cb956ab07a4c615f66a411b26c9d1d731cb564d75c38bdc"),
    ("ground_truth", "dad1d708601ef56e7e24e4e877bea9616820a81676b8b46fc88f9004865d9847"),
    ("evaluate", "07d5d48e3d3701ac044558585253c6892dd6fc5afa81ad255942e153bcbbb1f1"),
]


class BareSource(CaptureSource):
    def read(self, made: Path | None) -> Capture:
        return BARE


def test_the_keys_of_a_known_trial_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A photographs' trial without cameras: so the keys of the cameras that stand in for them are seen as well."""
    monkeypatch.setattr(init_module, "version", lambda package: "4.0.0")
    monkeypatch.setattr(inputs_module, "edited", lambda files: {})  # as in a release
    values = compose_one(WORDS).values
    trial = TrialSteps(Parts(values), Store(tmp_path / "store"), BareSource)
    keys = [("config", config_hash(values)), *((step.stage.name, step.key) for step in trial.steps())]
    assert keys == KEYS
