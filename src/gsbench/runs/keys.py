"""Hashes of what determines a result: of a configuration, and of each step of a trial (its key).

A step is a stage with its inputs. Its key is known before it runs. Loads neither Hydra nor torch.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.runs.code import OWN, ROOMS, changed_since_asked, edited, has_changed_since_import, states_of, user_modules
from gsbench.settings import option_fields

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


# ---- the inputs of a step: options of components, gsbench's code and the user's code


@dataclass(frozen=True)
class UserCode:
    """The user's code in a trial: the digests of its modules, and the classes that the configuration names.

    ``targets`` maps a place of the configuration (``densify``, ``eval.extra.sharp``) to a class's import path,
    gsbench's own classes included.
    """

    modules: Mapping[str, str] = field(default_factory=dict)
    targets: Mapping[str, str] = field(default_factory=dict)

    def is_behind(self, component: Any, place: str) -> bool:
        """Return whether the component's class is named by, or defined in, a module that is not gsbench's."""
        defined_in = f"{type(component).__module__}."
        return not (self.targets.get(place, OWN).startswith(OWN) and defined_in.startswith(OWN))


NO_USER_CODE = UserCode()


def options_of(group: str, component: Any, user: UserCode = NO_USER_CODE, place: str | None = None) -> dict[str, Any]:
    """The class and options of a component of ``group``, as they enter a stage's key.

    For gsbench's own classes, options that cannot change a result are left out. For a user's class, the digests of the
    user's modules are added. ``place`` is where the configuration names the class, if that is not the group.
    """
    cls, is_users = type(component), user.is_behind(component, place or group)
    values: dict[str, Any] = {"class": f"{cls.__module__}.{cls.__qualname__}"}
    if is_users:
        values["source"] = dict(user.modules)
    if is_dataclass(component):
        left_out = () if is_users else WITHOUT_EFFECT
        options = {one.name: getattr(component, one.name) for one in option_fields(cls) if one.name not in left_out}
        values |= json.loads(json.dumps(options, default=str))
    return values


def rasterizer_inputs(rasterizer: Any, user: UserCode = NO_USER_CODE) -> str | dict[str, Any]:
    """The rasterizer as it enters a stage's key: by name if gsbench's own, else by class, code and options."""
    name: str = rasterizer.name
    return {"name": name} | options_of("raster", rasterizer, user) if user.is_behind(rasterizer, "raster") else name


def step_of(
    stage: Stage,
    inputs: dict[str, Any],
    build: Callable[[Path], None],
    user: UserCode = NO_USER_CODE,
    in_processes: bool = False,
) -> Step:
    """A step. Its inputs get the states of those parts of gsbench's source behind it that differ from the release.

    ``in_processes`` says that the build starts processes, which import the code anew.
    """
    rooms = ROOMS[stage.name]
    states = states_of(rooms)

    def check() -> None:
        changed = [f"gsbench's {room}" for room in changed_since_asked(rooms)]
        changed += [f"the code of {name}" for name in user.modules if has_changed_since_import(name)]
        if changed:
            raise InputError(
                f"{', '.join(changed)} changed while {stage.name} ran, so it may have used the old and the new "
                "code: start again"
            )

    if edited_rooms := edited(states):
        inputs = inputs | {"code": edited_rooms}
    # This process keeps running the code that it imported. Processes that a build starts import the files as they are
    # then, so only for these an edit during the build matters.
    return Step(stage, inputs, build, states, check) if in_processes else Step(stage, inputs, build, states)
