"""The simulation of ``scripts/untruths.py``, for the tests."""

from __future__ import annotations

from tests.conftest import script

_module = script("untruths")

KINDS, rates, scene_pairs = _module.KINDS, _module.rates, _module.scene_pairs
