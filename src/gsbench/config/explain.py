"""Errors of a composition as one line, in terms of the user's words and files."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra.errors import MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)

from gsbench.config.groups import EXTERNAL_FOLDER, GROUPS, options
from gsbench.config.schema import class_defaults
from gsbench.errors import GsbenchError, InputError
from gsbench.system.install import conf_dir
from gsbench.words import did_you_mean

UNKNOWN = (ConfigAttributeError, ConfigKeyError)  # OmegaConf's errors for a key that is not there
MAX_MESSAGE = 400  # characters of an error that is quoted
# for a choice that does not exist, by group: the word may name a user's class or a missing plug-in
HINTS = {
    **{
        group: f"; a class of your own is named by {group}._target_"
        for group in ("densify", "init", "raster")
    },
    "hydra/launcher": "; other launchers are separate packages; launch=serial, local or slurm "
    "need none",
    "hydra/sweeper": "; gsbench has its own; a search is an interval and hydra.sweeper.tune.points",
}

Errors = type[Exception] | tuple[type[Exception], ...]


@contextmanager
def explained(words: Sequence[str], errors: Errors = Exception) -> Iterator[None]:
    """Raise the block's ``errors`` as InputError: one line in terms of the ``words``.

    By default these are all errors, since any error while Hydra composes comes from the user's
    input.
    """
    try:
        yield
    except GsbenchError:
        raise
    except errors as error:
        raise InputError(explain(error, words)) from error


def explain(error: BaseException, words: Sequence[str]) -> str:
    """An error of Hydra's or OmegaConf's in one line.

    It names the key, what is allowed, and the nearest choice.
    """
    causes = [error]
    while (cause := causes[-1].__cause__ or causes[-1].__context__) is not None:
        causes.append(cause)
    for cause in causes:
        if isinstance(cause, MissingConfigException) and cause.missing_cfg_file:
            return _missing_choice(cause.missing_cfg_file, cause.options or ())
        if isinstance(cause, UNKNOWN):
            return unknown_setting(cause, words)
        if isinstance(cause, MissingMandatoryValue) and cause.full_key:
            return f"{cause.full_key} is not set: give it a value"
        if isinstance(cause, OmegaConfBaseException):  # its other lines say what it says itself
            place = f"{cause.full_key}: " if cause.full_key else ""
            return place + " ".join(str(cause).partition("\n    ")[0].split())[:MAX_MESSAGE]
    return " ".join(" ".join(map(str, causes)).split())[:MAX_MESSAGE]


def _missing_choice(file: str, known: Sequence[str]) -> str:
    group, _, name = file.rpartition("/")
    group = group.removesuffix(f"/{EXTERNAL_FOLDER}")
    choices = sorted({*options(group), *known})
    near = did_you_mean(name, choices) or HINTS.get(group, "")
    return f"{group}={name} does not exist{near} (choose: {', '.join(choices)})"


def unknown_setting(error: Any, words: Sequence[str]) -> str:
    """The line for a key that does not exist, from OmegaConf's ``error``."""
    key, node = str(error.full_key or error.key), error.parent_node
    parent, _, name = key.rpartition(".")
    if parent == "hydra.sweeper.params":
        return f"{key}: params are for files of experiments; type {name}=… itself, with -m"
    if key in ("hydra.sweeper.grids", "hydra.sweeper.tune"):
        what = "joins grids" if name == "grids" else "tunes arms"
        return f"{key}: gsbench's own sweeper alone {what}, so leave out hydra/sweeper"
    return not_a_setting(key, node, words)


def not_a_setting(key: str, node: Any, words: Sequence[str]) -> str:
    """The line for a ``key`` that the ``node``, which should have it, does not have."""
    parent, _, name = key.rpartition(".")
    # Hydra's plug-ins are chosen by name, not by class
    hidden = "_target_" if parent.startswith("hydra") else "hydra"
    keys = (
        [str(known_key) for known_key in node if known_key != hidden]
        if isinstance(node, DictConfig)
        else []
    )
    elsewhere = _settings_of_choices(parent)
    near = did_you_mean(name, [*keys, *elsewhere])
    for known in elsewhere.keys() - set(keys):
        belongs = f"it belongs to {parent}={' or '.join(elsewhere[known][:3])}"
        meant = f"; did you mean {known}?"
        near = f"; {belongs}" if known == name else near.replace(meant, f"{meant} {belongs}")
    if not parent:
        near = near or did_you_mean(name, GROUPS) or _groups_with(key, node)
    if any(word.startswith(f"{parent}._target_=") for word in words):
        near += f"; a key that only your class has is added with a plus: +{key}=…"
    return (
        f"{key} is not a setting{near} ({parent or 'top level'} has: "
        f"{', '.join(keys) or 'no settings'})"
    )


def _groups_with(key: str, root: DictConfig) -> str:
    """``; did you mean scene.path?`` for a key that lacks its group; else nothing."""
    nodes = {group: OmegaConf.select(root, group) for group in GROUPS}
    places = [f"{group}.{key}" for group, node in nodes.items() if node is not None and key in node]
    return f"; did you mean {' or '.join(places)}?" if places else ""


def _settings_of_choices(group: str) -> dict[str, list[str]]:
    """The settings that files of a group's choices have, each with the names of these choices."""
    found: dict[str, list[str]] = {}
    of_classes = class_defaults().get(group, {})
    for name in options(group) if group in GROUPS else ():
        if "/" not in name:
            text = Path(conf_dir(), group, f"{name}.yaml").read_text(encoding="utf-8")
            keys = re.findall(r"^(\w+):", text, re.M)
            for one in re.findall(rf"/schema/{group}/(\w+)@", text):
                keys += of_classes[one]
            for key in keys:
                found.setdefault(key, []).append(name)
    found.pop("defaults", None)
    return found
