"""Parts of a configuration that determine a result, and their hash. Loads neither Hydra nor torch."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from gsbench.runs.code import OWN, user_modules

# Options of gsbench's own classes that cannot change a result; what they mean in a user's class, nobody knows.
WITHOUT_EFFECT = ("threads", "weights", "download", "time_limit_minutes")
# Settings of a group that say how results will be read, or what may be varied, whatever they are.
DECLARED = {"eval": ("primary", "controls"), "densify": ("switches",)}
NOT_HASHED = ("name", "seed", "device", "threads", "runs", "allow_targets", "tracking", "launch")


def config_hash(values: dict[str, Any]) -> str:
    """sha256 of what determines a result apart from the seed: not names, devices, folders, tracking or launchers."""
    modules = user_modules(values)
    return sha256_of(determining(values) | ({"code": modules} if modules else {}))


def determining(values: Mapping[str, Any]) -> dict[str, Any]:
    """The settings among ``values`` that determine a result, apart from the seed and the code of a user's classes."""
    kept = {key: value for key, value in values.items() if key not in NOT_HASHED}
    for key, group in kept.items():
        if isinstance(group, dict):
            without_effect = WITHOUT_EFFECT if str(group.get("_target_") or OWN).startswith(OWN) else ()
            dropped = (*without_effect, *DECLARED.get(key, ()))
            kept[key] = {name: value for name, value in group.items() if name not in dropped}
    return kept


def sha256_of(values: Any) -> str:
    """sha256 of canonical JSON: sorted keys, no spaces, floats by repr."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def flatten(mapping: Mapping[str, Any], keep_empty: bool = False) -> dict[str, Any]:
    """Nested mappings as one with dotted keys; an empty one within is dropped, unless ``keep_empty``.

    Examples:
        >>> flatten({"a": {"b": 1, "c": {}}, "d": [2]})
        {'a.b': 1, 'd': [2]}
    """
    flat: dict[str, Any] = {}
    for key, value in mapping.items():
        if isinstance(value, Mapping) and (value or not keep_empty):
            flat |= {f"{key}.{name}": entry for name, entry in flatten(value, keep_empty).items()}
        else:
            flat[str(key)] = value
    return flat
