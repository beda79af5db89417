"""Under which keys the results of one known trial lie in the store: a key that moves throws stored results away."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsbench.config.compose import compose_one
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.steps import code as code_module
from gsbench.pipeline.steps import init as init_module
from gsbench.pipeline.steps.capture import CaptureSource
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
    ("config", "829d41d8682f8e0ab480d40763b896e350b8d976d9e067920f049be019c6b979"),
    ("init", "974e9139210e7e6ef41a8ec7b4f58645d4493ac8e8a413880403cad374ed9df4"),  # of the cameras
    ("init", "c37f77392d25080252dd1ef80d5eb8cf9e7441e0778f5fb3a9eb1e0285416a16"),
    ("train", "1649b68fd180a316c33b0a173fa131e09765cd3a4aaf2d9923cf3158a4d8f426"),
    ("ground_truth", "ffebc31a202d233f2dd1c9af264a7e3e5cef988a8f4a5914c840336f97149d37"),
    ("evaluate", "3ecf34844d1c0c1042e002ae18189474e7cd5676aea0cfc7f5e8a70c40ae9b58"),
]


class BareSource(CaptureSource):
    def read(self, made: Path | None) -> Capture:
        return BARE


def test_the_keys_of_a_known_trial_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A photographs' trial without cameras: so the keys of the cameras that stand in for them are seen as well."""
    monkeypatch.setattr(init_module, "version", lambda package: "4.0.0")
    monkeypatch.setattr(code_module, "edited", lambda files: {})  # as in a release
    values = compose_one(WORDS).values
    trial = TrialSteps(Parts(values), Store(tmp_path / "store"), BareSource)
    keys = [("config", config_hash(values)), *((step.stage.name, step.key) for step in trial.steps())]
    assert keys == KEYS
