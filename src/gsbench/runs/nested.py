"""Nested values, as configurations and inputs of stages are: one flat mapping, entries, a hash."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

Values = Mapping[str, Any]  # the resolved configuration of a trial
TARGET = "_target_"  # the key of a class's import path
GSBENCH = "gsbench."  # prefix of the import paths of gsbench's own classes
SHOWN = 8  # characters of a hash in messages


def sha256_of(values: Any) -> str:
    """sha256 of canonical JSON: sorted keys, no spaces, floats by repr."""
    return hashlib.sha256(
        json.dumps(values, sort_keys=True, separators=(",", ":")).encode()
    ).hexdigest()


def flatten(mapping: Mapping[str, Any], keep_empty: bool = False) -> dict[str, Any]:
    """Nested mappings as one mapping with dotted keys; ``keep_empty`` keeps empty mappings.

    Examples:
        >>> flatten({"a": {"b": 1, "c": {}}, "d": [2]})
        {'a.b': 1, 'd': [2]}
    """
    flat: dict[str, Any] = {}
    for key, value in mapping.items():
        if isinstance(value, Mapping) and (value or not keep_empty):
            flat |= {f"{key}.{name}": inner for name, inner in flatten(value, keep_empty).items()}
        else:
            flat[str(key)] = value
    return flat


def targets_in(values: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every ``_target_`` at any depth, also in lists, as (keys to its mapping, target)."""
    return (
        (inner, value)
        for inner, key, value in entries_of(values, place)
        if key == TARGET and value is not None
    )


def entries_of(
    values: Any, place: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], str, Any]]:
    """Yield every entry at any depth, also in lists, as (keys that lead there, key, value)."""
    if isinstance(values, Mapping | list | tuple):
        for key, value in values.items() if isinstance(values, Mapping) else enumerate(values):
            yield place, str(key), value
            yield from entries_of(value, (*place, str(key)))
