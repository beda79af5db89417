"""The held-out views as they enter a step's key."""

from __future__ import annotations

from gsbench.runs.hashing import sha256_of
from gsbench.scene.types import Capture


def split_of(capture: Capture) -> str:
    """A hash of which views are held out."""
    return sha256_of(list(capture.test_names))
