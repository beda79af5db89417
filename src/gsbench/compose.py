"""From a command line to configurations: one for a trial, many for a sweep; Hydra's errors in one line."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import check, conf_dir, plain, register_schemas
from gsbench.errors import InputError
from gsbench.words import closest

GROUPS = ("scene", "init", "densify", "raster", "train", "eval", "tracking", "launch", "experiment")
MAX_MESSAGE = 400  # characters of an error of Hydra's that is not understood
SEED = re.compile(r"seed=(\d+)")


NO_PLUGINS = "hydra/launcher and hydra/sweeper are not used: choose launch=serial, local or slurm"


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
    _check_words(overrides)
    with _errors(overrides), _hydra():
        master = compose(
            "config", overrides=[word for word in overrides if not _is_sweep(word)], return_hydra_config=True
        )
        hydra = master.hydra
        if not hydra.launcher._target_.endswith(".BasicLauncher") or not hydra.sweeper._target_.endswith(
            ".BasicSweeper"
        ):
            raise InputError(NO_PLUGINS)
        is_sweep = multirun or (OmegaConf.select(hydra, "mode") is not None and hydra.mode.name == "MULTIRUN")
        if not is_sweep:
            swept = [word for word in overrides if _is_sweep(word)]
            if swept:
                raise InputError(f"{swept[0]} lists several values: add -m to run one trial for each")
            with open_dict(master):
                del master["hydra"]
            return [_composed(_check(master), overrides)]
        parameters = [f"{key}={value}" for key, value in (hydra.sweeper.params or {}).items()]
        return list(_sweep([*parameters, *overrides]))


def compose_one(overrides: Sequence[str]) -> Composed:
    """The configuration of the single trial that ``overrides`` describe, as ``Composed.overrides`` has them."""
    with _errors(overrides), _hydra():
        return _composed(_check(compose("config", overrides=list(overrides))), overrides)


def _sweep(words: Sequence[str]) -> Iterator[Composed]:
    """Every point of the grid; trials that differ in the seed alone share a composition."""
    grid: dict[str, list[str]] = {}
    for override in OverridesParser.create().parse_overrides(list(words)):
        key = override.get_key_element()
        if override.is_sweep_override():
            if not override.is_discrete_sweep():
                raise InputError(f"{override.input_line}: a sweep is a list of values, such as {key}=1,2,3")
            grid[key] = [f"{key}={value}" for value in override.sweep_string_iterator()]
        else:
            grid[key] = [_text(override)]
    known: dict[tuple[str, ...], DictConfig] = {}
    for point in itertools.product(*grid.values()):
        seeds = [match for word in point if (match := SEED.fullmatch(word))]
        rest = tuple(word for word in point if not SEED.fullmatch(word))
        if rest not in known:
            known[rest] = compose("config", overrides=list(point))
        config = known[rest]
        for match in seeds:
            config.seed = int(match.group(1))
        yield _composed(_check(config), point)


def _check_words(overrides: Sequence[str]) -> None:
    for word in overrides:
        if word.lstrip("+").startswith("experiment") and not word.startswith("+experiment="):
            raise InputError(f"{word}: write +experiment=NAME (choose: {', '.join(options('experiment'))})")
        if "=" not in word and not word.startswith("~"):
            raise InputError(f"{word!r} is not a setting like key=value")
        if word.lstrip("+~").startswith(("hydra/launcher", "hydra/sweeper")):
            raise InputError(NO_PLUGINS)


def _text(override: Override) -> str:
    key = override.get_key_element()
    return key if override.is_delete() else f"{key}={override.get_value_element_as_str()}"


def _is_sweep(word: str) -> bool:
    return bool(OverridesParser.create().parse_override(word).is_sweep_override())


def _check(config: DictConfig) -> DictConfig:
    check(config)
    return config


def _composed(config: DictConfig, overrides: Sequence[str]) -> Composed:
    return Composed(plain(config), OmegaConf.to_yaml(config, resolve=True), tuple(overrides))


@contextmanager
def _hydra() -> Iterator[None]:
    register_schemas()
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(conf_dir()), version_base="1.3", job_name="gsbench"):
        yield


@contextmanager
def _errors(overrides: Sequence[str]) -> Iterator[None]:
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
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
        return f"{key} is not a setting{file}{near} ({parent or 'top level'} has: {', '.join(known)})"
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
    value = re.search(r"(?:Value|Invalid value) '([^']*)'(.*?)\n\s*full_key: ([\w.\[\]]+)", text, re.S)
    if value:
        said = " ".join(value.group(2).split())
        said = re.sub(r"^of type '\w+' could not be converted to (\w+)", r"is not of type \1", said)
        return f"{value.group(3)}={value.group(1)} {said}".strip()
    text = re.sub(r"\s*(full_key|reference_type|object_type)[:=].*", "", text)
    return " ".join(text.split())[:MAX_MESSAGE]


def _chain(error: BaseException | None) -> list[str]:
    messages = []
    while error is not None:
        messages.append(str(error))
        error = error.__cause__
    return messages


def _keys_below(parent: str, overrides: Sequence[str]) -> list[str]:
    """The settings below ``parent`` with the group choices among ``overrides``, as far as these compose."""
    choices = [word for word in overrides if re.fullmatch(r"\w+=[\w-]+", word) and word.split("=")[0] in GROUPS]
    with _hydra():
        try:
            config = compose("config", overrides=choices)
        except (HydraException, OmegaConfBaseException):
            config = compose("config")
    node = OmegaConf.select(config, parent) if parent else config
    return [str(key) for key in node] if isinstance(node, DictConfig) else []


def options(group: str) -> list[str]:
    """The YAML files of a group that come with gsbench."""
    return sorted(path.stem for path in Path(conf_dir(), group).glob("*.yaml"))


def options_text() -> str:
    """The choices of every group."""
    lines = ["Groups:"]
    for group in GROUPS:
        prefix = "+experiment" if group == "experiment" else group
        lines.append(f"  {prefix + '=':<13}{', '.join(options(group))}")
    return "\n".join(lines)
