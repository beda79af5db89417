"""The keys of one known trial in the store. If a key changes, stored results are not found."""

from pathlib import Path

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
    "scene=garden",
    "scene.path=photos",
    "init=random",
    "densify=volumetric",
    "densify.volume_threshold=0.05",
    "eval.lpips=[]",
    "eval.flip=false",
    "raster=cpu",
    "device=cpu",
    "threads=1",
    "seed=3",
]
BARE = Capture(
    "garden", Path("photos"), ("a.jpg", "b.jpg", "c.jpg"), ("a.jpg",), None, False, "0" * 64
)
KEYS = [
    ("config", "efb880968c80cdd904651c24a9fa44e607e6283f150f6dbad8f47651f0e9d49f"),
    # of the reference cameras
    ("init", "b5ba65df7105e9263ad05addef8425d35e29fe982775d730fbe604647ec2a9ae"),
    ("init", "cad201af4f604b328caa8c2ed8aca73b64062872f7f0a7b2461e97dbd362a442"),
    ("train", "7a176da93dc7e68fd25ee10044cf3183c8cb124d04f8db5675e00a55f16c0f6c"),
    ("ground_truth", "25bd2fff6458d0bf7b5f3c85e52eea1f097cf4fa10c2f93e6be1429d23b17af4"),
    ("evaluate", "69ed8884d31466e846c86a05ad11f0b2918b9739822a680d08a8389b04c93395"),
]


class BareSource(CaptureSource):
    def read(self, made: Path | None) -> Capture:
        return BARE


def test_the_keys_of_a_known_trial_do_not_change(tmp_path, monkeypatch):
    """The photographs come without cameras, so the step of the reference cameras has a key too."""
    monkeypatch.setattr(scene_module, "version_of", lambda package: "4.0.0")
    monkeypatch.setattr(keys, "edited", lambda files: {})  # as in a release
    values = compose_one(WORDS).values
    monkeypatch.setattr(pipeline_trial, "CaptureSource", BareSource)
    trial = TrialSteps(Parts(values), Store(tmp_path / "store"))
    found = [
        ("config", config_hash(values)),
        *((step.stage.name, step.key) for step in trial.steps()),
    ]
    assert found == KEYS
