"""Under which keys the results of one known trial lie in the store: a key that moves throws stored results away."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsbench.config.compose import compose_one
from gsbench.pipeline import trial as pipeline_trial
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.steps import scene as scene_module
from gsbench.pipeline.steps.scene import CaptureSource
from gsbench.pipeline.trial import TrialSteps
from gsbench.runs import keys
from gsbench.runs.keys import config_hash
from gsbench.runs.store import Store
from gsbench.scene.types import Capture

WORDS = [
    "scene=garden", "scene.path=photos", "init=random", "densify=volumetric", "densify.volume_threshold=0.05",
    "eval.lpips=[]", "eval.flip=false", "raster=cpu", "device=cpu", "threads=1", "seed=3",
]  # fmt: skip
BARE = Capture("garden", Path("photos"), ("a.jpg", "b.jpg", "c.jpg"), ("a.jpg",), None, False, "0" * 64)
KEYS = [
    ("config", "efb880968c80cdd904651c24a9fa44e607e6283f150f6dbad8f47651f0e9d49f"),
    ("init", "6599fceb46df18df358d574ef2868e5bc85c2b8debe3c0b07b0aceb77882c9af"),  # of the cameras
    ("init", "19174a6b3b6b609d44ce3db01225cc25635b08315e8ddff0edafa7848403a6e5"),
    ("train", "88c3ca899428dee0fb817e4ebae5b764dfc1916c06f6963ce0ff49d9207658ac"),
    ("ground_truth", "34c661b8e20d4f0cff6464efb17533ee1bb568d03fb173ac1c93634803011512"),
    ("evaluate", "96891892dfc2048c6292a3671abee7ef7349c31cedf2d8564b452702f9ff8ace"),
]


class BareSource(CaptureSource):
    def read(self, made: Path | None) -> Capture:
        return BARE


def test_the_keys_of_a_known_trial_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A photographs' trial without cameras: so the keys of the cameras that stand in for them are seen as well."""
    monkeypatch.setattr(scene_module, "version_of", lambda package: "4.0.0")
    monkeypatch.setattr(keys, "edited", lambda files: {})  # as in a release
    values = compose_one(WORDS).values
    monkeypatch.setattr(pipeline_trial, "CaptureSource", BareSource)
    trial = TrialSteps(Parts(values), Store(tmp_path / "store"))
    found = [("config", config_hash(values)), *((step.stage.name, step.key) for step in trial.steps())]
    assert found == KEYS
