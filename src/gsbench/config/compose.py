"""Configurations as Hydra composes them, looked at as a whole, and made ready for trials: for one, or for a sweep's."""

import copy
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra.core.config_loader import ConfigLoader
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from gsbench.config.command_words import (
    GROUPS,
    check_search_path,
    check_single,
    is_sweep,
    options,
    parse_word,
    searched_folders,
    typed_permissions,
)
from gsbench.config.hydra_entry import CONFIG_NAME, explained, hydra_ready
from gsbench.config.schema import Config, checked_values
from gsbench.config.trust import PERMISSIONS, check_composed, check_permissions
from gsbench.errors import InputError
from gsbench.parsing import LOADER, MOST_VALUES
from gsbench.runs.trial_folder import TrialFolder
from gsbench.settings import checked
from gsbench.system.own_modules import allow_modules


@dataclass(frozen=True)
class Trial:
    """A trial as it is asked for: its resolved values, the overrides that give them, and where its files lie.

    One that is read from its own ``config.yaml`` has no overrides. Raises InputError for values that would make run
    what their ``allow_targets`` does not name, wherever they come from.
    """

    values: dict[str, Any]
    overrides: tuple[str, ...]

    def __post_init__(self) -> None:
        check_permissions(self.values)

    @cached_property
    def yaml(self) -> str:
        """The values as they are written to the trial's folder."""
        return OmegaConf.to_yaml(OmegaConf.create(self.values))

    @cached_property
    def files(self) -> TrialFolder:
        """The trial's folder, with all that is in it."""
        return TrialFolder.of(self.values)

    @property
    def folder(self) -> Path:
        """The place of that folder."""
        return self.files.path


def compose_whole(words: Sequence[str], modules: str | None = None) -> DictConfig:
    """Compose the configuration of ``words``, with Hydra's node ``hydra``, and look at it before any object is made.

    Of a list of values none is chosen. From here on the modules are found that ``words`` allow: they are what somebody
    has typed, in the folder ``modules`` (default: the current one). Raises InputError, one line. Within `hydra_ready`.
    """
    allowed = typed_permissions(words)
    check_search_path(words, allowed)
    check_files(searched_folders(words))
    allow_modules(allowed, os.getcwd() if modules is None else modules)
    with explained(words), warnings.catch_warnings():
        warnings.filterwarnings("error", message=r".* is not available\.", module="hydra")  # a folder to search in
        chosen = [word for word in words if not is_sweep(word)]
        return look_at(hydra.compose(CONFIG_NAME, chosen, return_hydra_config=True), allowed)


def check_files(folders: Sequence[Path]) -> None:
    """Refuse a file of a user's ``folders`` whose aliases stand for more values than Hydra could ever read."""
    for file in (file for folder in folders for depth in ("", "*/", "*/*/") for file in folder.glob(f"{depth}*.yaml")):
        try:
            text = file.read_text(encoding="utf-8") if file.is_file() else ""
            count = _values_of(text)
        except (OSError, ValueError, yaml.YAMLError):  # Hydra says so where it reads the file
            continue
        if count > MOST_VALUES:
            raise InputError(f"{file}: its aliases stand for more than {MOST_VALUES:,} values")


def _values_of(text: str) -> int:
    """The number of values that a YAML text stands for, an alias counted as often as what it names."""
    if "*" not in text:
        return 0
    sizes: dict[str, int] = {}
    opened: list[tuple[str | None, int]] = [(None, 0)]
    for event in yaml.parse(text, Loader=LOADER):
        anchor, size = getattr(event, "anchor", None), 0
        if isinstance(event, yaml.CollectionStartEvent):
            opened.append((anchor, 1))
            continue
        if isinstance(event, yaml.AliasEvent):
            size = sizes.get(event.anchor, 0)
        elif isinstance(event, yaml.ScalarEvent):
            size = 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, size = opened.pop()
        if anchor is not None:
            sizes[anchor] = size
        opened[-1] = (opened[-1][0], opened[-1][1] + size)
    return opened[0][1]


def look_at(config: DictConfig, allowed: Sequence[str]) -> DictConfig:
    """Refuse a composed configuration that would make run what is not ``allowed``, which no file of it can say."""
    check_composed(config, allowed)
    with read_write(config), open_dict(config):
        config[PERMISSIONS] = list(allowed)
    return config


def compose_one(overrides: Sequence[str], modules: str | None = None) -> Trial:
    """The single trial that ``overrides`` describe.

    The user's own modules are looked for in the folder ``modules`` (default: the current one).
    """
    check_single(overrides, "choose one")
    with hydra_ready():
        return ready_trial(compose_whole(overrides, modules), overrides)


def ready_trial(config: DictConfig, overrides: Sequence[str]) -> Trial:
    """The trial of a composed configuration, which stays as it is."""
    with explained(overrides):  # such as an interpolation that leads nowhere
        return Trial(checked_values(config), tuple(overrides))


def has_part(config: DictConfig, key: str) -> bool:
    """Return whether a configuration has the part ``key``, with dots."""
    return OmegaConf.select(config, key) is not None


def options_text(folders: Sequence[Path] = ()) -> str:
    """The choices of every group: gsbench's own, and those in the user's ``folders``."""
    lines = ["Groups:"]
    for group in GROUPS:
        prefix = "+experiment" if group == "experiment" else group
        lines.append(f"  {prefix + '=':<13}{', '.join(options(group, folders))}")
    return "\n".join(lines)


# ---- the trials of a sweep, from the words of each
#
# Hydra takes a tenth of a second for a composition, and a sweep may have ten thousand trials; so what their words have
# in common is composed once. In Hydra's order values come after the files that groups choose: trials that choose the
# same files share those, and trials that differ in the seed alone share all else.

ADDED = ("hydra.mode", "hydra.sweeper.grids")  # settings that `gsbench.app.command` adds to those that were typed
SEED = re.compile(r"seed=(\d+)")
# The seed, and settings of groups but for those that name a class (``_target_``).
PLAIN_KEY = re.compile(r"seed|(?!hydra\b)[a-zA-Z]\w*(\.[a-zA-Z]\w*)+")
# Text that may ask for the seed: by its name, or by one that is made when it is asked for.
MAY_ASK_FOR_SEED = re.compile(r"\$\{[^}]*(seed|\$\{)")


def compose_jobs(loader: ConfigLoader, sweep: DictConfig, jobs: Sequence[Sequence[str]]) -> list[Trial]:
    """The trials of a ``sweep``, Hydra's configuration of it, from the words of each."""
    by_files: dict[tuple[str, ...], DictConfig] = {}
    by_settings: dict[tuple[str, ...], Trial] = {}
    trials = []
    for_hydra, allowed = typed(sweep.hydra.overrides)[0], tuple(sweep.allow_targets)
    for words in jobs:
        given = (*for_hydra, *words)
        seeds = [int(match.group(1)) for word in words if (match := SEED.fullmatch(word))]
        others = tuple(word for word in words if not SEED.fullmatch(word))
        if seeds and others in by_settings:
            trials.append(replace(with_seed(by_settings[others], seeds[-1]), overrides=given))
            continue
        values = _plain_values(words)
        files = (*(word for word in words if word.partition("=")[0] not in values), *values)
        with explained(given):
            if files in by_files:
                composed = copy.deepcopy(by_files[files])
                for key, value in values.items():
                    OmegaConf.update(composed, key, value)
            else:
                check_search_path(words, allowed)
                composed = by_files[files] = look_at(loader.load_sweep_config(sweep, list(words)), allowed)
                with read_write(composed), open_dict(composed):
                    composed.pop("hydra")  # a large part, of which no trial asks
            asks = MAY_ASK_FOR_SEED.search(repr(OmegaConf.to_container(composed, resolve=False)))
            trials.append(ready_trial(composed, given))
        if not asks:
            by_settings[others] = trials[-1]
    return trials


def resolve_times(sweep: DictConfig) -> None:
    """Resolve the settings of a sweep, so that its trials, which take over what is resolved, have one ``${now:…}``."""
    for key in [str(key) for key in sweep if key != "hydra"]:
        with suppress(OmegaConfBaseException):  # such as a setting that only a trial's words give
            if OmegaConf.is_config(sweep[key]):
                OmegaConf.to_container(sweep[key], resolve=True)


def typed(overrides: DictConfig) -> tuple[list[str], list[str]]:
    """The words for Hydra and those for gsbench of a node ``hydra.overrides``, as they were typed."""
    given: Any = OmegaConf.to_container(overrides, resolve=False)
    return [word for word in given["hydra"] if word.partition("=")[0] not in ADDED], given["task"]


def with_seed(trial: Trial, seed: int) -> Trial:
    """The same trial with another seed, for one whose other settings do not ask for it."""
    seed = checked(Config, {"seed": seed}, "")["seed"]
    words = tuple(f"seed={seed}" if word.startswith("seed=") else word for word in trial.overrides)
    return replace(trial, values=trial.values | {"seed": seed}, overrides=words)


def _plain_values(words: Sequence[str]) -> Mapping[str, Any]:
    """Numbers and texts that words give to settings; none where the order of the words may matter."""
    keys = [key for key in map(_key, words) if "." in key]
    parents = {key[:dot] for key in keys for dot in range(len(key)) if key[dot] == "."}
    if len(set(keys)) < len(keys) or parents & set(keys) or any(map(_is_mapping, words)):
        return {}
    return {key: value for key, value in map(_key_and_value, words) if PLAIN_KEY.fullmatch(key) and _is_plain(value)}


@cache
def _key_and_value(word: str) -> tuple[str, Any]:
    """The key of a word with its signs, and the value that Hydra reads."""
    override = parse_word(word)
    return word.partition("=")[0], None if override.is_sweep_override() else override.value()


def _key(word: str) -> str:
    return _key_and_value(word)[0].lstrip("+~")


def _is_mapping(word: str) -> bool:
    return isinstance(_key_and_value(word)[1], dict)


def _is_plain(value: object) -> bool:
    return isinstance(value, int | float) or (isinstance(value, str) and "$" not in value)
