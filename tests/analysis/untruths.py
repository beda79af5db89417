"""The simulation of ``scripts/untruths.py``, for the tests."""

from tests.conftest import script

decision_rules = script("decision_rules")  # first, since the other imports it
_module = script("untruths")

KINDS, rates, scene_pairs = _module.KINDS, _module.rates, _module.scene_pairs
