"""Inputs of a step's key: options of components, the held-out views, the code of gsbench and the user's."""

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
    """The user's code of a trial: the digests of its modules, and the import paths of its classes by their places.

    Places are those of the configuration (``densify``, ``eval.extra.sharp``); gsbench's own classes stand there too.
    """

    modules: Mapping[str, str] = dataclasses.field(default_factory=dict)
    targets: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def is_behind(self, component: Any, place: str) -> bool:
        """Return whether the component is asked for at, or its class defined in, a module that is not gsbench's."""
        defined = f"{type(component).__module__}."
        return not (self.targets.get(place, OWN).startswith(OWN) and defined.startswith(OWN))


GSBENCH_ALONE = UserCode()


def options_of(group: str, component: Any, user: UserCode = GSBENCH_ALONE, place: str | None = None) -> dict[str, Any]:
    """Class and options of a component of ``group``, as they enter a stage's key.

    Options of gsbench's own classes that cannot change a result are left out; a user's class has the code of the user's
    modules beside it. ``place`` is where the configuration names the class, if that is not the group.
    """
    cls, users = type(component), user.is_behind(component, place or group)
    values: dict[str, Any] = {"class": f"{cls.__module__}.{cls.__qualname__}"}
    if users:
        values["source"] = dict(user.modules)
    if dataclasses.is_dataclass(component):
        left_out = () if users else WITHOUT_EFFECT
        fields = [field.name for field in dataclasses.fields(component) if field.init and field.name not in left_out]
        values |= {name: _plain(getattr(component, name)) for name in fields}
    return values


def rasterizer_inputs(rasterizer: Rasterizer, user: UserCode = GSBENCH_ALONE) -> str | dict[str, Any]:
    """The rasterizer as it enters a stage's key: gsbench's own by name, a user's by class, code and options."""
    if not user.is_behind(rasterizer, "raster"):
        return rasterizer.name
    return {"name": rasterizer.name} | options_of("raster", rasterizer, user)


def split_of(capture: Capture) -> str:
    """A hash of which views are held out."""
    return sha256_of(list(capture.test_names))


def step_of(
    stage: Stage,
    inputs: dict[str, Any],
    build: Callable[[Path], None],
    user: UserCode = GSBENCH_ALONE,
    in_processes: bool = False,
) -> Step:
    """A step whose inputs also have the states of gsbench's rooms behind it that are not as released.

    ``in_processes``: the work is done in processes of their own, which load the code anew.
    """
    rooms = ROOMS[stage.name]
    states = states_of(rooms)

    def check() -> None:
        late = [f"gsbench's {room}" for room in changed_since_asked(rooms)]
        late += [f"the code of {name}" for name in user.modules if has_changed_since_import(name)]
        if late:
            raise InputError(
                f"{', '.join(late)} changed while {stage.name} ran, so it may have used the old and the new "
                "code: start again"
            )

    changed = edited(states)
    every = inputs | ({"code": changed} if changed else {})
    # This process runs on as it was imported; processes that a build starts import what is there then.
    return Step(stage, every, build, states, check) if in_processes else Step(stage, every, build, states)


def _plain(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    return value if isinstance(value, (str, int, float, bool, type(None))) else str(value)
