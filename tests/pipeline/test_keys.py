"""The keys of one known trial in the store. If a key changes, stored results are not found."""

from pathlib import Path
from shlex import split

from gsbench.config.compose import compose_one
from gsbench.pipeline import trial as pipeline_trial
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.steps import scene as scene_module
from gsbench.pipeline.steps.scene import CaptureSource
from gsbench.pipeline.trial import TrialSteps
from gsbench.runs import keys
from gsbench.runs.config_hash import config_hash
from gsbench.runs.store import Store
from gsbench.scene.types import Capture

WORDS = split(
    "scene=garden scene.path=photos init=random densify=volumetric "
    "densify.volume_threshold=0.05 eval.lpips=[] eval.flip=false raster=cpu device=cpu "
    "threads=1 seed=3"
)
BARE = Capture(
    "garden", Path("photos"), ("a.jpg", "b.jpg", "c.jpg"), ("a.jpg",), None, False, "0" * 64
)
KEYS = [
    ("config", "efb880968c80cdd904651c24a9fa44e607e6283f150f6dbad8f47651f0e9d49f"),
    # of the reference cameras
    ("init", "e1e2cc0ffbc07319732fed7422ab68b11ed01ff824860ad4a65d461a0ecf95e4"),
    ("init", "38db22c2a2523f5c5cc4f47e7aaffbb1327018bcc9211b8f1ae05ed29e39c37b"),
    ("train", "8f6e851193877c649550b05cb2477f28ff6b3638ed7a7b504c3518a3d758f871"),
    ("ground_truth", "47c5600464d4eb387175d3ff8484e73c41678360da8a9c7155674afcaef84a65"),
    ("evaluate", "c832c3ae6a6d906f56a3c3ad09afe5aa63a1f576bb5f0b99f016b8fdb02f8cdc"),
]


class BareSource(CaptureSource):
    def read(self, made):
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
