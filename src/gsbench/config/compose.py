"""Configurations as Hydra composes them, made ready for trials; Hydra's errors in one line."""

from __future__ import annotations

import copy
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict

from gsbench.config.command_words import GROUPS, check_single, options
from gsbench.config.hydra_guard import GuardedLoader, typed_permissions
from gsbench.config.hydra_internals import VERSION_BASE
from gsbench.config.hydra_job import CONFIG_NAME, HydraJob
from gsbench.config.old_names import know_old_names
from gsbench.config.schema import check, check_values, plain, register_schemas
from gsbench.errors import InputError
from gsbench.system.install import conf_dir
from gsbench.system.own_modules import allow_modules
from gsbench.words import closest

if TYPE_CHECKING:
    from hydra._internal.hydra import Hydra

MAX_MESSAGE = 400  # characters of an error of Hydra's that is not understood
HINTS = {  # where a word may name a class of the user's, or a plug-in of Hydra's that is not installed
    **{group: f"; a class of your own is named by {group}._target_" for group in ("densify", "init", "raster")},
    "hydra/launcher": "; other launchers are packages of their own, which launch=serial, local or slurm do not need",
    "hydra/sweeper": "; other sweepers are packages of their own",
}
ASKED = re.compile(r"\$\{hydra:\s*([\w.]+)\s*\}")


@dataclass(frozen=True)
class Composed:
    """The configuration of one trial: resolved values, the same as YAML, and the overrides that give it.

    ``job`` is what Hydra knows of the trial where it runs as a job of Hydra's. One that was ``recorded`` is read from
    its own ``config.yaml``, and no overrides give it.
    """

    values: dict[str, Any]
    yaml: str
    overrides: tuple[str, ...]
    job: HydraJob | None = field(default=None, compare=False, repr=False)
    recorded: bool = False


@contextmanager
def composing() -> Iterator[Hydra]:
    """Hydra with gsbench's configuration, as ``hydra.main`` would make it."""
    register_schemas()
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(conf_dir()), job_name="gsbench", **VERSION_BASE):
            hydra = GlobalHydra.instance().hydra
            assert hydra is not None
            know_old_names(hydra.config_loader)
            _guard(hydra, (), os.getcwd())
            yield hydra
    finally:
        HydraConfig.instance().cfg = None


def compose_master(
    hydra: Hydra, words: Sequence[str], mode: RunMode = RunMode.RUN, modules: str | None = None
) -> DictConfig:
    """Compose the configuration of ``words``, with Hydra's settings in the node ``hydra``; raises InputError, one line.

    From here on the modules are found that ``words`` allow: they are what somebody has typed, in the folder
    ``modules`` (default: the current one).
    """
    folder = os.getcwd() if modules is None else modules
    _guard(hydra, words, folder)
    allow_modules(typed_permissions(words), folder)
    with explained(words), warnings.catch_warnings():
        warnings.filterwarnings("error", message=r".* is not available\.", module="hydra")  # a folder to search in
        return hydra.compose_config(CONFIG_NAME, list(words), run_mode=mode)


def _guard(hydra: Hydra, words: Sequence[str], folder: str) -> None:
    """Let ``hydra`` compose only what cannot make anything run that ``words`` do not allow, typed in ``folder``."""
    path = hydra.config_loader.get_search_path()
    hydra.config_loader = GuardedLoader(path, typed_permissions(words), folder)


def compose_one(overrides: Sequence[str], modules: str | None = None) -> Composed:
    """The configuration of the single trial that ``overrides`` describe, as ``Composed.overrides`` has them.

    The user's own modules are looked for in the folder ``modules`` (default: the current one).
    """
    check_single(overrides, "choose one")
    with composing() as hydra:
        return ready_trial(compose_master(hydra, overrides, modules=modules), overrides)


def compose_values(overrides: Sequence[str]) -> DictConfig:
    """The configuration to look at: every value is allowed, and what a trial needs may still be missing."""
    with composing() as hydra:
        config = compose_master(hydra, overrides)
        with explained(overrides):
            values = without_hydra(config)
            check_values(values)
    return values


def ready_trial(config: DictConfig, overrides: Sequence[str], job: HydraJob | None = None) -> Composed:
    """The trial of a composed configuration, checked; ``config`` stays as it is."""
    return resolved(settle(config, overrides), overrides, job)


def settle(config: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Check ``config`` and return the trial's part of it: a copy without Hydra's own node ``hydra``."""
    with explained(overrides):  # such as an interpolation that leads nowhere
        trial = without_hydra(config)
        _check_asked(trial)
        check(trial)
    return trial


def without_hydra(config: DictConfig) -> DictConfig:
    """A copy without the node ``hydra``, which stays known to the values that ask for it."""
    trial = copy.deepcopy(config)
    if "hydra" in trial:  # else Hydra has taken it already, and knows it: it runs the job
        with open_dict(trial):
            del trial["hydra"]
        if asks_hydra(trial):
            HydraConfig.instance().set_config(config)
    return trial


def asks_hydra(trial: DictConfig) -> bool:
    """Return whether a value asks Hydra (``${hydra:…}``): such a value differs from trial to trial, or may."""
    return "${hydra" in raw_text(trial)


def raw_text(config: DictConfig) -> str:
    """All that stands in a configuration, before any ``${…}`` is resolved."""
    return repr(OmegaConf.to_container(config, resolve=False))


def _check_asked(trial: DictConfig) -> None:
    """Refuse ``${hydra:…}`` for what is not known yet, which Hydra would make None or nothing in a text."""
    hydra: Any = HydraConfig.instance().cfg
    for path in ASKED.findall(raw_text(trial)):
        parent, _, key = f"hydra.{path}".rpartition(".")
        node = OmegaConf.select(hydra, parent)
        if OmegaConf.is_missing(node, key):
            reason = "a job has it only in a sweep: add -m" if path.startswith("job.") else "it is known in a job only"
            raise InputError(f"${{hydra:{path}}}: {reason}")


def resolved(config: DictConfig, overrides: Sequence[str], job: HydraJob | None) -> Composed:
    """The trial of a settled configuration."""
    with explained(overrides):
        return Composed(plain(config), OmegaConf.to_yaml(config, resolve=True), tuple(overrides), job)


@contextmanager
def explained(overrides: Sequence[str]) -> Iterator[None]:
    """Raise what the block raises as InputError, one line in terms of the words that were given."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # Hydra lets errors of any kind through, and all that it works on is the user's
        raise InputError(explain(error, overrides)) from error


def explain(error: BaseException, overrides: Sequence[str]) -> str:
    """Hydra's error in one line that names the key, what is allowed, and the nearest choice."""
    text = " ".join(_chain(error))
    override = re.search(r"Could not override '([^']+)'", text)
    unknown = re.search(r"Key '([^']+)' (?:is not in struct|not in '[^']+')", text)
    if unknown:
        key = override.group(1) if override else unknown.group(1)
        bad = unknown.group(1)
        if bad in ("grids", "tune"):
            what = "joins grids" if bad == "grids" else "tunes arms"
            return f"hydra.sweeper.{bad}: gsbench's own sweeper alone {what}, so leave out hydra/sweeper"
        parent = key[: key.rindex(bad)].rstrip(".") if bad in key else key.rpartition(".")[0]
        where = re.search(r"In '([^']+)'", text)
        file = ""
        if where and not override:  # in a YAML file, whose folder is the group
            file, parent = f" in {where.group(1)}.yaml", where.group(1).rpartition("/")[0]
        known = _keys_below(parent, overrides)
        own = any(word.startswith(f"{parent}._target_=") for word in overrides)
        hint = f"; a key that only your class has is added with a plus: +{key}=…" if own else ""
        near = f"{closest(bad, known)}{hint}"
        return f"{key} is not a setting{file}{near} ({parent or 'top level'} has: {', '.join(known) or 'no settings'})"
    group = re.search(
        r"Could not override '([\w/]+)'\.?\s*(?:Did you mean to override|No match in the defaults list)", text
    )
    if group:
        word = group.group(1)
        known = [*GROUPS, *_keys_below("", overrides)]
        return f"{word} is not a group or setting{closest(word, known)} (groups: {', '.join(GROUPS)})"
    missing = re.search(
        r"Could not find '([^']+)'.*?Available options in '([^']+)':\s*(.*?)(?:\n\n|Config search|$)", text, re.S
    )
    if missing:
        wanted, name = missing.group(1), missing.group(2)
        choices = sorted({*options(name), *re.findall(r"[\w.-]+", missing.group(3))})
        word = wanted.rpartition("/")[2]
        near = closest(word, choices) or HINTS.get(name, "")
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


def _chain(error: BaseException | None) -> list[str]:
    messages = []
    while error is not None:
        messages.append(str(error))
        error = error.__cause__
    return messages


def _keys_below(parent: str, overrides: Sequence[str]) -> list[str]:
    """The settings below ``parent`` with the group choices among ``overrides``, as far as these compose."""
    groups = (*GROUPS, "hydra/launcher", "hydra/sweeper")
    choices = [word for word in overrides if re.fullmatch(r"[\w/]+=[\w/-]+", word) and word.split("=")[0] in groups]
    with composing() as hydra:
        try:
            config = hydra.compose_config(CONFIG_NAME, choices, RunMode.RUN)
        except Exception:  # noqa: BLE001 - the choices may be what is wrong
            config = hydra.compose_config(CONFIG_NAME, [], RunMode.RUN)
    node = OmegaConf.select(config, parent) if parent else config
    hidden = "_target_" if parent.startswith("hydra") else "hydra"  # a plug-in is chosen by its name
    return [str(key) for key in node if key != hidden] if isinstance(node, DictConfig) else []


def options_text(folders: Sequence[Path] = ()) -> str:
    """The choices of every group: gsbench's own, and those in the user's ``folders``."""
    lines = ["Groups:"]
    for group in GROUPS:
        prefix = "+experiment" if group == "experiment" else group
        lines.append(f"  {prefix + '=':<13}{', '.join(options(group, folders))}")
    return "\n".join(lines)
