"""The held-out views of a trial, as its settings say them in short text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsbench.runs.hashing import BEFORE

BY_LISTS = "list"  # of scene.split


def setting(config: Mapping[str, Any], key: str) -> Any:
    """A setting of a configuration with dotted keys; of one older than the setting, its value of before."""
    return config.get(key, BEFORE.get(key))


def split_text(config: Mapping[str, Any]) -> str:
    """``every_nth``, ``sector 0 of 8`` or ``list``, and whether it is matched, or for validation."""
    text, sectors = str(setting(config, "scene.split")), setting(config, "scene.sectors")
    if text == "sector":
        text = f"sector {setting(config, 'scene.sector')} of {sectors}"
    if config.get("scene.train_list") or config.get("scene.test_list"):
        text = BY_LISTS
    elif setting(config, "scene.match_views"):
        text += ", matched" if text.startswith("sector") else f", matched with {sectors}"
    return f"{text}, validation" if setting(config, "scene.validation") else text
