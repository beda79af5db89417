"""Rules on all that a configuration may run, reach and overwrite.

`check_composed` checks a composed configuration, Hydra's own settings included, before Hydra makes
any object of it. `check_permissions` checks the resolved values of each trial before its parts are
made. `docs/security.md` says what this protects from. Loads no Hydra by itself.
"""

import os
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf

from gsbench.config.permissions import (
    ALLOWED,
    PACKAGE,
    check_launch,
    check_program,
    check_target,
    check_texts,
    is_allowed,
    is_external,
    load_class,
    packages_allowed_at,
    permission_advice,
)
from gsbench.errors import InputError
from gsbench.runs.code import PERMISSIONS
from gsbench.runs.configuration import TARGET, entries_of, targets_in

OWN_RUNS = "${oc.env:GSBENCH_RUNS,runs}"

# Hydra's nodes of which plug-ins and loggers are made. What an installed package writes there is
# trusted.
MADE_NODES = ("launcher", "sweeper", "job_logging", "hydra_logging")
CLASS_KEYS = ("class", "()")  # logging's keys of import paths
# Classes of this form are not imported for the check, since an import may take seconds.
PUBLIC_CLASS = re.compile(rf"{PACKAGE}\.\w+\.[A-Z]\w*")
# Settings that a sweep in a file may not vary: its jobs are composed after the check of the whole
# configuration.
NOT_SWEPT = re.compile(rf"[\s+~]*(hydra|runs|{PERMISSIONS})\s*([./@:=\[]|$)")


def check_permissions(values: Mapping[str, Any]) -> None:
    """Refuse a trial's resolved configuration that would run what its ``allow_targets`` lacks.

    This is the last check, of plain values, from any file or command line. Raises InputError.
    """
    allowed = values.get(PERMISSIONS) or []
    # At any depth: an allowed class may build the classes that its own options name.
    for place, key, value in entries_of(values):
        check_key((*place, key))
        if key == TARGET and value is not None:
            check_target(value, ".".join(place), allowed, packages_allowed_at(place))
    if is_external(values["densify"]):
        check_program(values["densify"], allowed)
    check_launch(values["launch"], allowed)
    tracking = values["tracking"]
    if tracking.get("enabled", True) and (address := foreign_address(tracking, allowed)):
        raise InputError(
            f"results would go to {address}, which only a file names; if you trust it, "
            f"{permission_advice([address], allowed)}; tracking=none sends nothing"
        )


def check_key(path: Sequence[str]) -> None:
    """Refuse a key by which Hydra makes objects in another way, such as a function from a class."""
    if path[-1] in ALLOWED["special"]:
        raise InputError(f"{'.'.join(path)}: gsbench makes no objects this way: leave it out")


def foreign_address(tracking: Mapping[str, Any], allowed: Sequence[str]) -> str:
    """An address in the settings ``tracking`` that only a file names, which may not be used, or "".

    The user's own are those ``allowed`` on the command line, and those in the environment.
    """
    known = {*allowed, *map(os.environ.get, ALLOWED["addresses"])}
    given = ((key, str(value)) for key, value in tracking.items() if value)
    places = (text for key, text in given if key == "uri" or "://" in text)
    return next((place for place in places if place not in known), "")


def check_composed(
    config: DictConfig, allowed: Sequence[str], installed: Mapping[str, Any]
) -> None:
    """Refuse a composed configuration, with Hydra's node, that would run what is not ``allowed``.

    ``installed`` has Hydra's nodes as the installed packages alone write them for the same choices.
    The values are checked before ``${…}`` is resolved. An interpolation that could change what runs
    is refused. Raises InputError.
    """
    raw: Any = OmegaConf.to_container(config, resolve=False)
    usual = {
        (*place, key): value
        for place, key, value in entries_of({"runs": OWN_RUNS, "hydra": installed})
    }
    words = [word for own in raw["hydra"]["overrides"].values() for word in own]
    typed = {word.partition("=")[0].lstrip("+~") for word in words}
    for place, key, value in entries_of(raw):
        path = (*place, key)
        if usual.get(path) == value:
            continue
        if not isinstance(value, dict | list):  # files of packages were not looked at before
            check_texts({key: value}, allowed, ".".join(place))
        check_key(path)
        # The schema or Hydra reports a target that is no text.
        if key == TARGET and isinstance(value, str) and value != "???":
            is_callback = place[:2] == ("hydra", "callbacks") and len(place) == 3
            # gsbench's classes are allowed in their own group only:
            # `densify._target_=gsbench.init.…` is refused.
            own = ALLOWED["callbacks"] if is_callback else packages_allowed_at(place)
            check_target(value, ".".join(place), allowed, own)
            if is_allowed(value, (PACKAGE,)) and not PUBLIC_CLASS.fullmatch(value):
                # refuses names such as gsbench.densify.adc.torch.load
                load_class(value, ".".join(place), allowed)
        _check_hydra(path, value, typed, allowed)


def _check_hydra(
    path: tuple[str, ...], value: Any, typed: Collection[str], allowed: Sequence[str]
) -> None:
    """Refuse a setting that would start code by Hydra, or write elsewhere.

    No installed package has written it; ``typed`` are the keys of the words of the command line.
    """
    where, node = ".".join(path), path[1] if path[0] == "hydra" and len(path) > 1 else ""
    key = path[-2] if path[-1].isdigit() else path[-1]
    text = value if isinstance(value, str) else ""
    if where == "hydra.job.env_set" and value:
        # A variable can name a file that Python, a library or a program loads, and no list of
        # harmless ones is complete.
        raise InputError(
            "hydra.job.env_set can change what runs: set variables in the shell, before the command"
        )
    if where in ALLOWED["written"] and value is not None and where not in typed:
        raise InputError(
            f"a file sets {where}={value}, a place to write: type it on the command line"
        )
    if path[:2] == ("hydra", "sweeper") and path[2:3] and path[2] in ALLOWED["swept"]:
        # A job is composed after this check, and its words could name packages to import
        # configurations from.
        if swept := next(filter(NOT_SWEPT.match, (path[-1], text)), ""):
            raise InputError(
                f"{'.'.join(path[:-1])}: {swept} cannot differ from job to job, and no file can "
                "allow it: type it on the command line"
            )
        return
    if node in (*MADE_NODES, "callbacks") and "${" in text:  # may become a class
        raise InputError(f"{where}: write the settings themselves here, without ${{…}}")
    if not text or node not in MADE_NODES or key == TARGET:
        return
    # In any text, logging imports the name after ext://.
    is_plain = (
        key in ALLOWED["keys"] + ALLOWED["sbatch"] and "://" not in text and text.isprintable()
    )
    if key in CLASS_KEYS:
        if not is_allowed(text, allowed):
            advice = permission_advice([text.split(".")[0]], allowed)
            raise InputError(
                f"{where}={text} is not what a package set; if you trust that code, {advice}"
            )
    elif not is_plain and text not in ALLOWED["texts"] and not is_allowed(f"hydra.{node}", allowed):
        advice = permission_advice([f"hydra.{node}"], allowed)
        raise InputError(
            f"{where}={text!r} could start code or write a file; if you trust it, {advice}"
        )


def load_callbacks(callbacks: Any, allowed: Sequence[str]) -> None:
    """Import the callback classes that ``hydra.callbacks`` names.

    Raises InputError for anything else.
    """
    from hydra.experimental.callback import Callback

    for name, callback in (callbacks or {}).items():
        if not isinstance(callback, Mapping) or not callback.get(TARGET):
            raise InputError(f"hydra.callbacks.{name} names no {TARGET}: the class to use")
        for place, target in targets_in(callback, ("hydra", "callbacks", str(name))):
            cls = load_class(target, ".".join(place), [*allowed, *ALLOWED["callbacks"]])
            base, what = (
                (Callback, "a class of hydra.experimental.callback.Callback")
                if len(place) == 3
                else (object, "a class")
            )
            if not isinstance(cls, type) or not issubclass(cls, base):
                raise InputError(f"{'.'.join(place)}.{TARGET}={target} is not {what}")
