"""Inputs of a step's key: the options of components, the held-out views, gsbench's code and the user's code."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.raster import Rasterizer
from gsbench.runs.code import (
    OWN,
    ROOMS,
    changed_since_asked,
    edited,
    has_changed_since_import,
    states_of,
)
from gsbench.runs.keys import WITHOUT_EFFECT, Stage, Step, sha256_of
from gsbench.scene.types import Capture


@dataclasses.dataclass(frozen=True)
class UserCode:
    """The user's code in a trial: the digests of its modules, and the classes that the configuration names.

    ``targets`` maps a place of the configuration (``densify``, ``eval.extra.sharp``) to a class's import path,
    gsbench's own classes included.
    """

    modules: Mapping[str, str] = dataclasses.field(default_factory=dict)
    targets: Mapping[str, str] = dataclasses.field(default_factory=dict)

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
    if dataclasses.is_dataclass(component):
        left_out = () if is_users else WITHOUT_EFFECT
        fields = [field.name for field in dataclasses.fields(component) if field.init and field.name not in left_out]
        values |= {name: _plain(getattr(component, name)) for name in fields}
    return values


def rasterizer_inputs(rasterizer: Rasterizer, user: UserCode = NO_USER_CODE) -> str | dict[str, Any]:
    """The rasterizer as it enters a stage's key: by name if gsbench's own, else by class, code and options."""
    if not user.is_behind(rasterizer, "raster"):
        return rasterizer.name
    return {"name": rasterizer.name} | options_of("raster", rasterizer, user)


def split_hash(capture: Capture) -> str:
    """A hash of the names of the held-out views."""
    return sha256_of(list(capture.test_names))


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

    edited_rooms = edited(states)
    all_inputs = inputs | ({"code": edited_rooms} if edited_rooms else {})
    # This process keeps running the code that it imported. Processes that a build starts import the files as they are
    # then, so only for these an edit during the build matters.
    return Step(stage, all_inputs, build, states, check) if in_processes else Step(stage, all_inputs, build, states)


def _plain(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    return value if isinstance(value, (str, int, float, bool, type(None))) else str(value)
