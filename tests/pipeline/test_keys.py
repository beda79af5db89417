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
    ("init", "991c126deb4c8459394f2310586bfbb26251e999e306344a946a5826c7fb07d9"),
    ("init", "be87afd1f24decd7478d620990cb56e1cc80f616bd5045809f5a0ed92ef3a68a"),
    ("train", "faf230c48612eddd14d6476ed24f063202faa9d70628a6b4403336516d42a95d"),
    ("ground_truth", "3989bfa30383b1f506f4107150a86428b608f6e06dd12db46466e1d0d20cab1e"),
    ("evaluate", "25bd0eccbb4e655e8384a52618a6e0624d3d0d977f8c3dc7fe234f4ed6fee1b8"),
]


class BareSource(CaptureSource):
    step = None

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
