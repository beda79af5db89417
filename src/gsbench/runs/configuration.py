"""Configurations as nested values, and the purpose of each setting (purposes.yaml)."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from gsbench.parsing import table_beside

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


# ---- the purpose of settings

BOOKKEEPING, READING, PLACE = "bookkeeping", "reading", "place"
PURPOSES = {
    key: purpose
    for purpose, keys in table_beside(__file__, "purposes.yaml").items()
    for key in keys
}
# Options that cannot change a result, and are in no hash. This holds for gsbench's own classes; a
# user's class may use the names otherwise.
WITHOUT_EFFECT = ("threads", "weights", "download", "time_limit_minutes")
# settings that each scene of an arm may have for itself
OF_A_SCENE = ("scene", "init.path", "train.iterations")


@cache
def purpose(key: str) -> str:
    """The purpose of the setting of a dotted key (`PURPOSES`); "" if it determines the model."""
    return PURPOSES.get(key) or (purpose(key.rpartition(".")[0]) if "." in key else "")


def is_hashed(key: str) -> bool:
    """Return whether the setting of a dotted key, or its group, counts in the configuration's hash.

    `determining_settings` then leaves out some settings within groups.
    """
    return purpose(key) != BOOKKEEPING


def is_ignored(key: str) -> bool:
    """Return whether trials of one cell may differ in a setting."""
    return purpose(key) in (BOOKKEEPING, READING, PLACE)


def is_ingredient(key: str) -> bool:
    """Return whether a setting may change the trained model."""
    return not purpose(key)


@cache
def is_of_scene(key: str) -> bool:
    """Return whether each scene of an arm may have its own value."""
    return key in OF_A_SCENE or ("." in key and is_of_scene(key.rpartition(".")[0]))


def determining_settings(values: Values) -> dict[str, Any]:
    """The settings among ``values`` that determine a result, without the seed."""
    kept = {key: value for key, value in values.items() if is_hashed(key)}
    for key, group in kept.items():
        if isinstance(group, dict):
            is_own = str(group.get(TARGET) or GSBENCH).startswith(GSBENCH)
            kept[key] = {
                name: value
                for name, value in group.items()
                if purpose(f"{key}.{name}") != READING and not (is_own and name in WITHOUT_EFFECT)
            }
    return kept


def arm_hash(values: Values) -> str:
    """sha256 of what an arm is made of: classes and settings, without names, code and evaluation.

    Arms of one hash are the same arm, whatever its name, and versions of it if their code differs.
    """
    return sha256_of(
        {
            key: value
            for key, value in flatten(values).items()
            if value is not None and is_ingredient(key)
        }
    )
