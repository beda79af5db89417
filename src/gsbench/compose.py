"""From a command line to configurations: one for a trial, many for a sweep; Hydra's errors in one line."""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf, open_dict

from gsbench.command_words import GROUPS, check_sweep, check_words, is_sweep, options
from gsbench.config import Config, check, check_values, conf_dir, plain, register_schemas
from gsbench.errors import InputError
from gsbench.settings import checked
from gsbench.words import closest

MAX_MESSAGE = 400  # characters of an error of Hydra's that is not understood
SEED = re.compile(r"seed=(\d+)")


@dataclass(frozen=True)
class Composed:
    """The configuration of one trial: resolved values, the same as YAML, and the overrides that give it."""

    values: dict[str, Any]
    yaml: str
    overrides: tuple[str, ...]


def compose_trials(overrides: Sequence[str], multirun: bool = False) -> list[Composed]:
    """The trials that ``overrides`` describe: one, or with ``multirun`` (or in an experiment that is a sweep) a grid.

    Raises InputError, one line, for what does not compose or does not hold together.
    """
    check_words(overrides)
    swept = [word for word in overrides if is_sweep(word)]
    with composing():
        master = _compose([word for word in overrides if word not in swept], overrides, return_hydra_config=True)
        hydra = master.hydra
        if not (multirun or (OmegaConf.select(hydra, "mode") is not None and hydra.mode.name == "MULTIRUN")):
            if swept:
                raise InputError(f"{swept[0]} lists several values: add -m to run one trial for each")
            with open_dict(master):
                del master["hydra"]
            return [_composed(master, overrides)]
        parameters = [f"{key}={value}" for key, value in (hydra.sweeper.params or {}).items()]
        return list(_sweep([*parameters, *overrides], overrides))


def compose_one(overrides: Sequence[str]) -> Composed:
    """The configuration of the single trial that ``overrides`` describe, as ``Composed.overrides`` has them."""
    check_words(overrides)
    if swept := [word for word in overrides if is_sweep(word)]:
        raise InputError(f"{swept[0]} lists several values: choose one")
    with composing():
        return _composed(_compose(overrides, overrides), overrides)


def compose_values(overrides: Sequence[str]) -> DictConfig:
    """The configuration to look at: every value is allowed, and what a trial needs may still be missing."""
    with composing():
        config = _compose(overrides, overrides)
    with _errors(overrides):
        check_values(config)
    return config


def _sweep(words: Sequence[str], given: Sequence[str]) -> Iterator[Composed]:
    """Every point of the grid; trials that differ in the seed alone share a composition."""
    grid: dict[str, list[str]] = {}
    for override in _parse_grid(words, given):
        key = override.get_key_element()
        if override.is_sweep_override():
            check_sweep(override)
            try:
                grid[key] = [f"{key}={value}" for value in override.sweep_string_iterator()]
            except ValueError as error:  # such as a range of steps of 0
                raise InputError(f"{override.input_line}: {error}") from error
            if not grid[key]:
                raise InputError(f"{override.input_line} lists no value")
        else:
            grid[key] = [_text(override)]
    known: dict[tuple[str, ...], DictConfig] = {}
    for point in itertools.product(*grid.values()):
        seeds = [match for word in point if (match := SEED.fullmatch(word))]
        rest = tuple(word for word in point if not SEED.fullmatch(word))
        if rest not in known:
            known[rest] = _compose(point, given)
            yield _composed(known[rest], point)
            continue
        config = known[rest]
        for match in seeds:
            config.seed = checked(Config, {"seed": int(match.group(1))}, "")["seed"]
        yield _resolved(config, point)


def _parse_grid(words: Sequence[str], given: Sequence[str]) -> list[Override]:
    with _errors(given):
        return list(OverridesParser.create(GlobalHydra.instance().config_loader()).parse_overrides(list(words)))


def _compose(words: Sequence[str], given: Sequence[str], return_hydra_config: bool = False) -> DictConfig:
    """What Hydra makes of ``words``; its errors are explained in terms of what was ``given``."""
    with _errors(given), warnings.catch_warnings():
        warnings.filterwarnings("error", message=r".* is not available\.", module="hydra")  # a folder to search in
        return compose("config", overrides=list(words), return_hydra_config=return_hydra_config)


def _text(override: Override) -> str:
    key = override.get_key_element()
    return key if override.is_delete() else f"{key}={override.get_value_element_as_str()}"


def _composed(config: DictConfig, overrides: Sequence[str]) -> Composed:
    with _errors(overrides):  # such as an interpolation that leads nowhere
        check(config)
        return _resolved(config, overrides)


def _resolved(config: DictConfig, overrides: Sequence[str]) -> Composed:
    return Composed(plain(config), OmegaConf.to_yaml(config, resolve=True), tuple(overrides))


@contextmanager
def composing() -> Iterator[None]:
    """Hydra, ready to compose from ``conf``."""
    register_schemas()
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(conf_dir()), version_base="1.3", job_name="gsbench"):
        yield


@contextmanager
def _errors(overrides: Sequence[str]) -> Iterator[None]:
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
        return f"{name}={word} does not exist{closest(word, choices)} (choose: {', '.join(choices)})"
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
    choices = [word for word in overrides if re.fullmatch(r"\w+=[\w-]+", word) and word.split("=")[0] in GROUPS]
    with composing():
        try:
            config = compose("config", overrides=choices)
        except Exception:  # noqa: BLE001 - the choices may be what is wrong
            config = compose("config")
    node = OmegaConf.select(config, parent) if parent else config
    return [str(key) for key in node] if isinstance(node, DictConfig) else []


def options_text() -> str:
    """The choices of every group."""
    lines = ["Groups:"]
    for group in GROUPS:
        prefix = "+experiment" if group == "experiment" else group
        lines.append(f"  {prefix + '=':<13}{', '.join(options(group))}")
    return "\n".join(lines)
