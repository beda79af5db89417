"""The two entry points into Hydra, composing a configuration and running an app, and its errors in one line."""

import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import hydra
import hydra.utils
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from gsbench.config.command_words import GROUPS, options
from gsbench.config.schema import register_schemas
from gsbench.config.trust import HYDRAS_CALLBACKS
from gsbench.errors import GsbenchError, InputError
from gsbench.system.install import conf_dir
from gsbench.words import did_you_mean

CONFIG_NAME = "config"  # conf/config.yaml
# Hydra 1.3 warns unless it is told which version's defaults hold; Hydra 1.4 has one set and warns if it is told.
VERSION_BASE: dict[str, Any] = {"version_base": "1.3"} if hydra.__version__.startswith("1.3.") else {}
# From Hydra 1.4 on: within this context it instantiates the named classes only (``mine.*``: all of a module).
WHITELIST: Callable[[Sequence[str]], AbstractContextManager[Any]] = getattr(
    hydra.utils, "execution_whitelist", lambda names: nullcontext()
)
HYDRAS_LINE = "Error executing job with overrides"


@contextmanager
def hydra_ready() -> Iterator[None]:
    """Initialise Hydra with gsbench's configuration folder within the block."""
    register_schemas()
    if GlobalHydra.instance().is_initialized():  # within `hydra.main`, or in a block of ours
        yield
        return
    try:
        with hydra.initialize_config_dir(str(conf_dir()), job_name="gsbench", **VERSION_BASE):
            yield
    finally:
        HydraConfig.instance().cfg = None


def run_main(task: Callable[[Any], Any], argv: Sequence[str], allowed: Sequence[str] = ()) -> None:
    """Run ``task`` as an app of ``hydra.main`` with the words ``argv``; raises what ``task`` raises.

    Hydra may instantiate the callback classes that ``allowed`` names, and its own.
    """
    names = [name for name in allowed if all(part.isidentifier() for part in name.split("."))]
    register_schemas()
    saved_argv, sys.argv = sys.argv, ["gsbench", *argv]
    saved_full_error = os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # otherwise Hydra prints errors itself and exits
    stderr, sys.stderr = sys.stderr, _WithoutHydrasLine(sys.stderr)
    try:
        with WHITELIST([*HYDRAS_CALLBACKS, *names, *(f"{name}.*" for name in names)]):
            hydra.main(**VERSION_BASE, config_path=str(conf_dir()), config_name=CONFIG_NAME)(task)()
    finally:
        sys.argv, sys.stderr = saved_argv, stderr
        os.environ.pop("HYDRA_FULL_ERROR")
        if saved_full_error is not None:
            os.environ["HYDRA_FULL_ERROR"] = saved_full_error
        HydraConfig.instance().cfg = None


class _WithoutHydrasLine:
    """Standard error without the line that Hydra writes before it raises a job's error. gsbench prints that error."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        return len(text) if text.startswith(HYDRAS_LINE) else int(self._stream.write(text))


# ---- errors

MAX_MESSAGE = 400  # characters of a Hydra error that `explain` does not recognise
HINTS = {  # for a choice that does not exist, by group: the word may name a user's class or a missing plug-in
    **{group: f"; a class of your own is named by {group}._target_" for group in ("densify", "init", "raster")},
    "hydra/launcher": "; other launchers are separate packages; launch=serial, local or slurm need none",
    "hydra/sweeper": "; gsbench has its own; a search is an interval and hydra.sweeper.tune.points",
}

Errors = type[Exception] | tuple[type[Exception], ...]


@contextmanager
def explained(overrides: Sequence[str], errors: Errors = Exception) -> Iterator[None]:
    """Raise the block's ``errors`` as InputError: one line in terms of the words ``overrides``.

    The default is any error, since while Hydra composes all errors come from the user's input.
    """
    try:
        yield
    except GsbenchError:
        raise
    except errors as error:
        raise InputError(explain(error, overrides)) from error


def explain(error: BaseException, overrides: Sequence[str]) -> str:
    """Hydra's error in one line that names the key, what is allowed, and the nearest choice."""
    text = " ".join(_chain(error))
    override = re.search(r"Could not override '([^']+)'", text)
    unknown = re.search(r"Key '([^']+)' (?:is not in struct|not in '[^']+')", text)
    if unknown:
        return _unknown_setting(unknown.group(1), override.group(1) if override else None, text, overrides)
    group = re.search(
        r"Could not override '([\w/]+)'\.?\s*(?:Did you mean to override|No match in the defaults list)", text
    )
    if group:
        word = group.group(1)
        keys = [*GROUPS, *_keys_below("", overrides)]
        return f"{word} is not a group or setting{did_you_mean(word, keys)} (groups: {', '.join(GROUPS)})"
    missing = re.search(
        r"Could not find '([^']+)'.*?Available options in '([^']+)':\s*(.*?)(?:\n\n|Config search|$)", text, re.S
    )
    if missing:
        wanted, name = missing.group(1), missing.group(2)
        choices = sorted({*options(name), *re.findall(r"[\w.-]+", missing.group(3))})
        word = wanted.rpartition("/")[2]
        near = did_you_mean(word, choices) or HINTS.get(name, "")
        return f"{name}={word} does not exist{near} (choose: {', '.join(choices)})"
    absent = re.search(r"[Mm]issing mandatory value: ([\w.]+)", text)
    if absent:
        return f"{absent.group(1)} is not set: give it a value"
    folder = re.search(r"provider=.* path=(.*) is not available", text)
    if folder:
        return f"hydra.searchpath names {folder.group(1)}: no such folder"
    place = re.search(r"full_key: ([\w.\[\]]+)", text)
    text = re.sub(r"\s*(full_key|reference_type|object_type)[:=].*", "", text)
    return (f"{place.group(1)}: " if place else "") + " ".join(text.split())[:MAX_MESSAGE]


def _unknown_setting(bad: str, given: str | None, text: str, overrides: Sequence[str]) -> str:
    """The error for an unknown key ``bad``. ``given`` is the command line's whole key; None for a key in a file."""
    if given and given.startswith("hydra.sweeper.params."):
        return f"{given}: params are for files of experiments; type {given.partition('params.')[2]}=… itself, with -m"
    if bad in ("grids", "tune"):
        what = "joins grids" if bad == "grids" else "tunes arms"
        return f"hydra.sweeper.{bad}: gsbench's own sweeper alone {what}, so leave out hydra/sweeper"
    key = given or bad
    parent = key[: key.rindex(bad)].rstrip(".") if bad in key else key.rpartition(".")[0]
    where = re.search(r"In '([^']+)'", text)
    file = ""
    # A YAML file's folder is the group. In an experiment's file, Hydra's full_key says where the key stands.
    if where and not given:
        group, _, name = where.group(1).rpartition("/")
        full = re.search(r"full_key: ([\w.]+)", text)
        key = full.group(1) if full and full.group(1).endswith(bad) else f"{group}.{bad}"
        file, parent = f" in {group}/{name}.yaml", key.rpartition(".")[0]
    keys = _keys_below(parent, overrides)
    is_users_class = any(word.startswith(f"{parent}._target_=") for word in overrides)
    hint = f"; a key that only your class has is added with a plus: +{key}=…" if is_users_class else ""
    near = _belongs_to(parent, bad) or did_you_mean(bad, keys) or _groups_with(key)
    return f"{key} is not a setting{file}{near}{hint} ({parent or 'top level'} has: {', '.join(keys) or 'no settings'})"


def _groups_with(key: str) -> str:
    """``; did you mean scene.path?`` for a key that lacks its group; else nothing."""
    groups = [group for group in GROUPS if group != "experiment"] if "." not in key else []
    places = [f"{group}.{key}" for group in groups if key in _keys_below(group, [])]
    return f"; did you mean {' or '.join(places)}?" if places else ""


def _belongs_to(group: str, key: str) -> str:
    """``; it belongs to densify=volumetric`` if other choices of a group have the setting; else nothing."""
    if group not in GROUPS:
        return ""
    key_line = re.compile(rf"^{re.escape(key)}:", re.M)
    files = {name: Path(conf_dir(), group, f"{name}.yaml") for name in options(group) if "/" not in name}
    choices = [name for name, file in files.items() if key_line.search(file.read_text(encoding="utf-8"))]
    return f"; it belongs to {group}={' or '.join(choices[:3])}" if choices else ""


def _chain(error: BaseException | None) -> list[str]:
    """The messages of an error and of its causes."""
    messages = []
    while error is not None:
        messages.append(str(error))
        error = error.__cause__
    return messages


def _keys_below(parent: str, overrides: Sequence[str]) -> list[str]:
    """The settings below ``parent``, with the group choices among ``overrides`` if these compose."""
    groups = (*GROUPS, "hydra/launcher", "hydra/sweeper")
    choices = [word for word in overrides if re.fullmatch(r"[\w/]+=[\w/-]+", word) and word.split("=")[0] in groups]
    with hydra_ready():
        try:
            config = hydra.compose(CONFIG_NAME, choices, return_hydra_config=True)
        except Exception:  # noqa: BLE001 - a choice itself may be wrong
            config = hydra.compose(CONFIG_NAME, [], return_hydra_config=True)
    node = OmegaConf.select(config, parent) if parent else config
    hidden = "_target_" if parent.startswith("hydra") else "hydra"  # Hydra's plug-ins are chosen by name, not by class
    return [str(key) for key in node if key != hidden] if isinstance(node, DictConfig) else []
