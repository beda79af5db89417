"""The small scene of the tests of training, for the steps around it, and what steps report."""

from contextlib import nullcontext

import pytest

from gsbench.pipeline.steps import evaluate, scene, train
from tests.train.conftest import tiny_scene, truth

__all__ = ["tiny_scene", "truth"]


@pytest.fixture
def told(monkeypatch):
    """The progress that steps report."""
    reported = []
    for module in (evaluate, scene, train):
        monkeypatch.setattr(
            module, "progress", lambda title: nullcontext(lambda *one: reported.append(one))
        )
    return reported
