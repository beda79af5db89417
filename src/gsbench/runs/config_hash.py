"""Purpose of each setting (purposes.yaml), and the hash of those that determine a result.

The hash names a trial's folder.
"""

from functools import cache
from typing import Any

from gsbench.parsing import table_beside
from gsbench.runs.nested import GSBENCH, TARGET, Values, flatten, sha256_of
from gsbench.runs.user_code import user_modules

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


def config_hash(values: Values) -> str:
    """sha256 of the settings and the user's code that determine a result, without the seed.

    Names, devices, folders, tracking and launchers do not change it.
    """
    modules = user_modules(values)
    return sha256_of(determining_settings(values) | ({"code": modules} if modules else {}))


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
