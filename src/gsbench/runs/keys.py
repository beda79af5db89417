"""Stages and steps of a trial, and the keys under which the store keeps their results.

A step is a stage with its inputs. Its key is known before it runs: the inputs contain the keys of
earlier steps, and the code of gsbench and of the user (`gsbench.runs.code`). Loads neither
Hydra nor torch.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.runs.code import (
    NO_USER_CODE,
    UserCode,
    changed_since_asked,
    edited,
    has_changed_since_import,
    states_of,
)
from gsbench.runs.configuration import WITHOUT_EFFECT, sha256_of
from gsbench.settings import option_fields


@dataclass(frozen=True)
class Stage:
    """A stage of the pipeline, such as training.

    ``version`` is bumped by hand when the stage's code computes something else. ``resumable``
    stages continue from the files of a killed build; the others start in an empty folder. Files
    that match ``scratch`` are needed only by the build, and removed when the result is
    complete.
    """

    name: str
    version: int
    resumable: bool = False
    scratch: tuple[str, ...] = ()

    def key(self, inputs: dict[str, Any]) -> str:
        """sha256 of the stage's name, its version and all inputs, which include upstream keys."""
        return sha256_of({"stage": self.name, "version": self.version, "inputs": inputs})


@dataclass(frozen=True)
class Step:
    """One step of a trial: ``build(folder)`` computes the result that ``inputs`` determine.

    ``code`` has the states of the packages that it uses (`CODE_OF_STAGE`). ``check`` is called
    after building; it raises if other code than that in ``inputs`` may have built the result.
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
CAPTURE = Stage("scene", 2)
INIT = Stage("init", 4, resumable=True)
TRAIN = Stage("train", 5, resumable=True, scratch=("checkpoint-*.pt",))
GROUND_TRUTH = Stage("ground_truth", 1)
EVALUATE = Stage("evaluate", 3)
VIEWS = Stage("views", 5)  # undistorted photographs of their final size; no step of a trial

STAGES = (CAPTURE, INIT, TRAIN, GROUND_TRUTH, EVALUATE)

# The packages of each stage: folders and files of gsbench that determine its numbers. Code that
# cannot change a number is not listed. Nor is code that makes objects from settings: keys contain
# the settings themselves. An edit of one densifier changes the package of all densifiers; in
# return, the table is simple enough to check.
MODEL = ("scene", "gaussians", "densify", "raster", "train", "events.py", "normalization.py")
LOSS = ("eval/ssim.py", "eval/images.py", "eval/pictures.py")
CODE_OF_STAGE = {
    "scene": ("scene", "init", "normalization.py", "pipeline/steps/scene.py"),
    "init": (
        "scene",
        "init",
        "gaussians",
        "normalization.py",
        "weights.py",
        "pipeline/steps/scene.py",
    ),
    "train": (*MODEL, *LOSS, "external", "pipeline/steps/train.py", "pipeline/steps/external.py"),
    "ground_truth": ("scene", "normalization.py", "pipeline/steps/scene.py"),
    "evaluate": (*MODEL, "eval", "weights.py", "pipeline/steps"),
    "views": ("scene",),
}


# ---- the inputs of a step: options of components, gsbench's code and the user's code


def options_of(
    group: str, component: Any, user: UserCode = NO_USER_CODE, place: str | None = None
) -> dict[str, Any]:
    """The class and options of a component of ``group``, as they enter a stage's key.

    For gsbench's own classes, options that cannot change a result are left out. For a user's class,
    the digests of the user's modules are added. ``place`` is where the configuration names the
    class, if that is not the group.
    """
    cls, is_users = type(component), user.is_behind(component, place or group)
    values: dict[str, Any] = {"class": f"{cls.__module__}.{cls.__qualname__}"}
    if is_users:
        values["source"] = dict(user.modules)
    if is_dataclass(component):
        left_out = () if is_users else WITHOUT_EFFECT
        options = {
            option.name: getattr(component, option.name)
            for option in option_fields(cls)
            if option.name not in left_out
        }
        values |= json.loads(json.dumps(options, default=str))
    return values


def rasterizer_inputs(rasterizer: Any, user: UserCode = NO_USER_CODE) -> str | dict[str, Any]:
    """The rasterizer in a stage's key: gsbench's own by name, others by class, code and options."""
    name: str = rasterizer.name
    return (
        {"name": name} | options_of("raster", rasterizer, user)
        if user.is_behind(rasterizer, "raster")
        else name
    )


def step_of(
    stage: Stage,
    inputs: dict[str, Any],
    build: Callable[[Path], None],
    user: UserCode = NO_USER_CODE,
    in_processes: bool = False,
) -> Step:
    """The step of ``stage`` with ``inputs``, which ``build`` computes.

    If packages behind it differ from the release, their states are added to the inputs.
    ``in_processes`` says that the build starts processes, which import the code
    anew.
    """
    packages = CODE_OF_STAGE[stage.name]
    states = states_of(packages)

    def check() -> None:
        changed = [f"gsbench's {package}" for package in changed_since_asked(packages)]
        changed += [f"code of {name}" for name in user.modules if has_changed_since_import(name)]
        if changed:
            raise InputError(
                f"{', '.join(changed)} changed while {stage.name} ran, so it may have used the old "
                "and the new code: start again"
            )

    if differing := edited(states):
        inputs = inputs | {"code": differing}
    # This process keeps running the code that it imported. Processes that a build starts import the
    # files as they are then, so only for these an edit during the build matters.
    return Step(stage, inputs, build, states, *[check] * in_processes)
