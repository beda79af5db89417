"""The settings that determine a result, and their hash, which names a trial's folder."""

from collections.abc import Mapping, Sequence
from typing import Any

from gsbench.runs.nested import GSBENCH, TARGET, flatten, sha256_of
from gsbench.runs.user_code import PERMISSIONS, user_modules

# Options that cannot change a result. This holds for gsbench's own classes; a user's class may use
# the names otherwise.
WITHOUT_EFFECT = ("threads", "weights", "download", "time_limit_minutes")
# Settings that only declare what is accepted, how results are read or what may be turned off.
# train.steps_scaler has been applied to the steps.
DECLARED = {
    "scene": ("accept",),
    "eval": ("primary", "baseline", "controls"),
    "densify": ("switches",),
    "train": ("steps_scaler",),
}
NOT_HASHED = (
    "name",
    "questions",
    "error_rate",
    "seed",
    "device",
    "threads",
    "runs",
    PERMISSIONS,
    "tracking",
    "launch",
)
# Settings in which trials of one cell may differ: they do not change what is computed.
# "x" stands for x and all below it (x.y).
IGNORED_SETTINGS = (
    *NOT_HASHED,
    *(f"{group}.{name}" for group, names in DECLARED.items() for name in names),
    "hydra",
    "experiment",
    "scene.path",
)
# Settings that do not change the trained model.
NO_INGREDIENTS = (
    *IGNORED_SETTINGS,
    "eval",
    "scene.name",
    "raster.name",
    "init.name",
    "init.device",
    "init.weights",
    "init.download",
    "init.threads",
    "densify.name",
    "densify.time_limit_minutes",
    "train.name",
    "train.log_every",
    "train.checkpoint_every",
    "train.checkpoint_minutes",
    "train.volume_histogram",
)


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


def arm_hash(values: Mapping[str, Any]) -> str:
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


def is_ingredient(key: str) -> bool:
    """Return whether a setting may change the trained model."""
    return not is_among(key, NO_INGREDIENTS)


def is_among(key: str, settings: Sequence[str]) -> bool:
    """Return whether a dotted key is one of ``settings`` or below one of them.

    A key that only begins with the same letters is another setting: a user's class may have the
    option ``densify.name_noise``.
    """
    parts = key.split(".")
    return any(".".join(parts[:count]) in settings for count in range(1, len(parts) + 1))
