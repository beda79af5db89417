"""Hashes of what determines a result: of a configuration, and of each step of a trial (its key).

A step is a stage with its inputs. Its key is known before it runs. Loads neither Hydra nor torch.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from gsbench.runs.code import OWN, user_modules

# Options that cannot change a result. This holds for gsbench's own classes; a user's class may use the names otherwise.
WITHOUT_EFFECT = ("threads", "weights", "download", "time_limit_minutes")
# Settings that only declare how results are read or what an ablation may turn off.
DECLARED = {"eval": ("primary", "controls"), "densify": ("switches",)}
NOT_HASHED = ("name", "seed", "device", "threads", "runs", "allow_targets", "tracking", "launch")


def config_hash(values: dict[str, Any]) -> str:
    """sha256 of the settings and the user's code that determine a result, without the seed.

    Names, devices, folders, tracking and launchers do not change it.
    """
    modules = user_modules(values)
    return sha256_of(determining_settings(values) | ({"code": modules} if modules else {}))


def determining_settings(values: Mapping[str, Any]) -> dict[str, Any]:
    """The settings among ``values`` that determine a result, without the seed."""
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
    """Nested mappings as one mapping with dotted keys; empty inner mappings are dropped unless ``keep_empty``.

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


# ---- stages and steps


@dataclass(frozen=True)
class Stage:
    """A stage of the pipeline, such as training. Bump ``version`` by hand when its code computes something else.

    ``resumable`` stages continue from the files of a killed build; the others start in an empty folder. Files that
    match ``scratch`` are needed only by the build, and removed when the result is complete.
    """

    name: str
    version: int
    resumable: bool = False
    scratch: tuple[str, ...] = ()

    def key(self, inputs: dict[str, Any]) -> str:
        """sha256 of the stage's name, its version and all of its inputs, which include upstream keys."""
        return sha256_of({"stage": self.name, "version": self.version, "inputs": inputs})


@dataclass(frozen=True)
class Step:
    """One step of a trial: ``build(folder)`` computes its result, which ``inputs`` (with upstream keys) determine.

    ``code`` has the states of the rooms that it uses (`gsbench.runs.code`). ``check`` is called after building; it
    raises if other code than that in ``inputs`` may have built the result.
    """

    stage: Stage
    inputs: dict[str, Any]
    build: Callable[[Path], None] = field(repr=False)
    code: Mapping[str, str] = field(default_factory=dict, repr=False)
    check: Callable[[], None] = field(default=lambda: None, repr=False)

    @cached_property
    def key(self) -> str:
        """The key under which the step's result is stored."""
        return self.stage.key(self.inputs)


# (name, version). Bump the version when the stage's code computes something else.
CAPTURE = Stage("scene", 1)
INIT = Stage("init", 1, resumable=True)
TRAIN = Stage("train", 2, resumable=True, scratch=("checkpoint-*.pt",))
GROUND_TRUTH = Stage("ground_truth", 1)
EVALUATE = Stage("evaluate", 2)

STAGES = (CAPTURE, INIT, TRAIN, GROUND_TRUTH, EVALUATE)
