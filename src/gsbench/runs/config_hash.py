"""The settings that determine a result, and their hash, which names a trial's folder."""

from collections.abc import Mapping
from typing import Any

from gsbench.runs.nested import GSBENCH, TARGET, sha256_of
from gsbench.runs.user_code import user_modules

# Options that cannot change a result. This holds for gsbench's own classes; a user's class may use
# the names otherwise.
WITHOUT_EFFECT = ("threads", "weights", "download", "time_limit_minutes")
# Settings that only declare how results are read or what an ablation may turn off.
# train.steps_scaler has been applied to the steps.
DECLARED = {"eval": ("primary", "controls"), "densify": ("switches",), "train": ("steps_scaler",)}
NOT_HASHED = ("name", "seed", "device", "threads", "runs", "allow_targets", "tracking", "launch")


def is_hashed(key: str) -> bool:
    """Return whether the setting of a dotted key, or its group, counts in the configuration's hash.

    `determining_settings` then leaves out some settings within groups.
    """
    return key.partition(".")[0] not in NOT_HASHED


def config_hash(values: Mapping[str, Any]) -> str:
    """sha256 of the settings and the user's code that determine a result, without the seed.

    Names, devices, folders, tracking and launchers do not change it.
    """
    modules = user_modules(values)
    return sha256_of(determining_settings(values) | ({"code": modules} if modules else {}))


def determining_settings(values: Mapping[str, Any]) -> dict[str, Any]:
    """The settings among ``values`` that determine a result, without the seed."""
    kept = {key: value for key, value in values.items() if is_hashed(key)}
    for key, group in kept.items():
        if isinstance(group, dict):
            dropped = set(DECLARED.get(key, ()))
            if str(group.get(TARGET) or GSBENCH).startswith(GSBENCH):
                dropped |= set(WITHOUT_EFFECT)
            kept[key] = {name: value for name, value in group.items() if name not in dropped}
    return kept
