"""Under which keys the results of one known trial lie in the store: a key that moves throws stored results away."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsbench.config.compose import compose_one
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.steps import init as init_module
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
    ("config", "6006ce2d5a24f06065a7ec3e0acce9d6afbbd0b8b2242059686c41e77927766d"),
    ("init", "b7ca2c34f15e6982b1cfe176048e01e1fa86b6b9acfd45ce66bb1443118d7fe8"),  # of the cameras
    ("init", "ac52126886c9371912391c051d2566f1598bbc65f7748aec1e579818c6fa9bf4"),
    ("train", "6dcae2ad1476c5e69fbc7d7ff24e581cdb9f9b66b3ed076e46c006a972d50d12"),
    ("ground_truth", "44b8d46ce327228f2d0da693aff1ca7d511b53713ed00bdd0d59ee20273c8e30"),
    ("evaluate", "381b3a2dbc8630c807f85b6a5141d317f8c087635dd0f4665edae7a022b45e75"),
]


def test_the_keys_of_a_known_trial_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A photographs' trial without cameras: so the keys of the cameras that stand in for them are seen as well."""
    monkeypatch.setattr(init_module, "version", lambda package: "4.0.0")
    values = compose_one(WORDS).values
    trial = TrialSteps(Parts(values), Store(tmp_path / "store"), lambda options, made: BARE)
    keys = [("config", config_hash(values)), *((step.stage.name, step.key) for step in trial.steps())]
    assert keys == KEYS
