"""The simulation of ``scripts/untruths.py``, for the tests."""

from __future__ import annotations

import importlib.util
import sys

from tests.conftest import ROOT

_spec = importlib.util.spec_from_file_location("untruths", ROOT / "scripts" / "untruths.py")
assert _spec is not None
assert _spec.loader is not None
_module = importlib.util.module_from_spec(_spec)
sys.modules[_spec.name] = _module
_spec.loader.exec_module(_module)

KINDS, rates, scene_pairs = _module.KINDS, _module.rates, _module.scene_pairs
