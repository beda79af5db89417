"""The small scene that trainings are tested on, here for what is done with a trained model."""

from tests.train.conftest import tiny_scene, truth

__all__ = ["tiny_scene", "truth"]
