"""Inputs that determine a result, and their hash: of a configuration, and of each step of a trial.

A step is a stage with its inputs; it knows its key without running. Loads neither Hydra nor torch.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
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


# ---- stages and steps


@dataclass(frozen=True)
class Stage:
    """A kind of work. Bump ``version`` by hand when its code changes what it computes.

    ``resumable`` stages find what a killed build left and go on from it; the others start in an empty folder. Files
    that match ``scratch`` serve the build only: they are removed when the result is complete.
    """

    name: str
    version: int
    resumable: bool = False
    scratch: tuple[str, ...] = ()

    def key(self, inputs: dict[str, Any]) -> str:
        """sha256 of canonical JSON of the stage and all that it reads, upstream keys included."""
        return sha256_of({"stage": self.name, "version": self.version, "inputs": inputs})


@dataclass(frozen=True)
class Step:
    """One piece of a trial: ``build(folder)`` computes its result, which ``inputs`` determine (upstream keys among
    them).

    ``code`` are the rooms of gsbench that have a part in it, with their states (`gsbench.runs.code`). ``check``, called
    when it is built, raises where other code may have built it than ``inputs`` say.
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


# By name and version: bump a version when the code of a stage computes something else.
CAPTURE = Stage("scene", 1)
INIT = Stage("init", 1, resumable=True)
TRAIN = Stage("train", 2, resumable=True, scratch=("checkpoint-*.pt",))
GROUND_TRUTH = Stage("ground_truth", 1)
EVALUATE = Stage("evaluate", 2)

STAGES = (CAPTURE, INIT, TRAIN, GROUND_TRUTH, EVALUATE)
