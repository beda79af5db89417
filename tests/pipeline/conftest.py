"""The small scene of the tests of training, for the steps around it."""

from tests.train.conftest import tiny_scene, truth

__all__ = ["tiny_scene", "truth"]
