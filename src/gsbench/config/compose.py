"""Composition by Hydra: the configuration of a command line, checked as a whole, and the trials that it describes."""

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
from gsbench.parsing import LOADER, MAX_VALUES
from gsbench.runs.trial_folder import TrialFolder
from gsbench.settings import check_values
from gsbench.system.own_modules import allow_modules


@dataclass(frozen=True)
class Trial:
    """A requested trial: its resolved values, the overrides that gave them, and the folder of its files.

    A trial that is read from its own ``config.yaml`` has no overrides. Raises InputError for values that would run code
    or programs that their ``allow_targets`` does not name.
    """

    values: dict[str, Any]
    overrides: tuple[str, ...]

    def __post_init__(self) -> None:
        check_permissions(self.values)

    @cached_property
    def yaml(self) -> str:
        """The text of the trial's ``config.yaml``."""
        return OmegaConf.to_yaml(OmegaConf.create(self.values))

    @cached_property
    def files(self) -> TrialFolder:
        """The trial's folder, with methods that read its files."""
        return TrialFolder.of(self.values)

    @property
    def folder(self) -> Path:
        """The path of the trial's folder."""
        return self.files.path


def compose_whole(words: Sequence[str], modules: str | None = None) -> DictConfig:
    """Compose the configuration of ``words``, Hydra's node ``hydra`` included, and check what it may run.

    Words that list several values are left out. From here on Python finds the modules that ``words`` allow in the
    folder ``modules`` (default: the current one). Raises InputError, one line. Call it within `hydra_ready`.
    """
    # The order matters: Hydra imports packages of the search path while it composes, so they are checked first.
    allowed = typed_permissions(words)
    check_search_path(words, allowed)
    check_files(searched_folders(words))
    allow_modules(allowed, os.getcwd() if modules is None else modules)
    with explained(words), warnings.catch_warnings():
        # Hydra only warns of a folder in its search path that does not exist.
        warnings.filterwarnings("error", message=r".* is not available\.", module="hydra")
        single = [word for word in words if not is_sweep(word)]
        return enforce_permissions(hydra.compose(CONFIG_NAME, single, return_hydra_config=True), allowed)


def check_files(folders: Sequence[Path]) -> None:
    """Refuse a file of the user's ``folders`` whose YAML aliases stand for too many values.

    A few lines of nested aliases can stand for billions of values ("billion laughs"), and Hydra would expand them.
    """
    for file in (file for folder in folders for depth in ("", "*/", "*/*/") for file in folder.glob(f"{depth}*.yaml")):
        try:
            text = file.read_text(encoding="utf-8") if file.is_file() else ""
            count = _expanded_size(text)
        except (OSError, ValueError, yaml.YAMLError):  # Hydra reports it if it reads the file
            continue
        if count > MAX_VALUES:
            raise InputError(f"{file}: its aliases stand for more than {MAX_VALUES:,} values")


def _expanded_size(text: str) -> int:
    """The number of values in a YAML text after each alias is replaced by what it names; 0 for a text without aliases.

    Counts in the parser's events, so that nothing is expanded.
    """
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


def enforce_permissions(config: DictConfig, allowed: Sequence[str]) -> DictConfig:
    """Refuse a composed configuration that would run what is not ``allowed``, and set its ``allow_targets`` to that.

    Setting it discards what a file says of ``allow_targets``.
    """
    check_composed(config, allowed)
    with read_write(config), open_dict(config):
        config[PERMISSIONS] = list(allowed)
    return config


def compose_one(overrides: Sequence[str], modules: str | None = None) -> Trial:
    """The single trial that ``overrides`` describe.

    The folder ``modules`` (default: the current one) is where the user's modules are looked for.
    """
    check_single(overrides, "choose one")
    with hydra_ready():
        return resolve_trial(compose_whole(overrides, modules), overrides)


def resolve_trial(config: DictConfig, overrides: Sequence[str]) -> Trial:
    """The trial of a composed configuration, with interpolations resolved in a copy."""
    with explained(overrides):
        return Trial(checked_values(config), tuple(overrides))


def has_key(config: DictConfig, key: str) -> bool:
    """Return whether a configuration has the dotted ``key``."""
    return OmegaConf.select(config, key) is not None


def options_text(folders: Sequence[Path] = ()) -> str:
    """The choices of every group: gsbench's own, and those in the user's ``folders``."""
    lines = ["Groups:"]
    for group in GROUPS:
        prefix = "+experiment" if group == "experiment" else group
        lines.append(f"  {prefix + '=':<13}{', '.join(options(group, folders))}")
    return "\n".join(lines)


# ---- the trials of a sweep
#
# Hydra takes a tenth of a second for a composition, and a sweep may have ten thousand trials. So what trials share is
# composed once. Hydra applies values after the files that groups choose. Trials that choose the same files share their
# composition, and trials that differ only in the seed share the resolved values too.

ADDED = ("hydra.mode", "hydra.sweeper.grids")  # settings that `gsbench.app.command` adds to the typed ones
SEED = re.compile(r"seed=(\d+)")
# The seed, or a setting of a group, except settings that name a class (``_target_``).
PLAIN_KEY = re.compile(r"seed|(?!hydra\b)[a-zA-Z]\w*(\.[a-zA-Z]\w*)+")
# An interpolation that may read the seed: it names the seed, or its own name is an interpolation.
MAY_READ_SEED = re.compile(r"\$\{[^}]*(seed|\$\{)")


def compose_jobs(loader: ConfigLoader, sweep: DictConfig, jobs: Sequence[Sequence[str]]) -> list[Trial]:
    """The trials of ``jobs``, each the list of its words; ``sweep`` is the configuration of the whole sweep."""
    by_files: dict[tuple[str, ...], DictConfig] = {}
    by_settings: dict[tuple[str, ...], Trial] = {}
    trials = []
    hydra_words, allowed = typed_words(sweep.hydra.overrides)[0], tuple(sweep.allow_targets)
    for words in jobs:
        overrides = (*hydra_words, *words)
        seeds = [int(match.group(1)) for word in words if (match := SEED.fullmatch(word))]
        without_seed = tuple(word for word in words if not SEED.fullmatch(word))
        if seeds and without_seed in by_settings:
            trials.append(replace(with_seed(by_settings[without_seed], seeds[-1]), overrides=overrides))
            continue
        values = _plain_values(words)
        files = (*(word for word in words if word.partition("=")[0] not in values), *values)
        with explained(overrides):
            if files in by_files:
                composed = copy.deepcopy(by_files[files])
                for key, value in values.items():
                    OmegaConf.update(composed, key, value)
            else:
                check_search_path(words, allowed)
                composed = by_files[files] = enforce_permissions(loader.load_sweep_config(sweep, list(words)), allowed)
                with read_write(composed), open_dict(composed):
                    composed.pop("hydra")  # large, and no trial reads it
            reads_seed = MAY_READ_SEED.search(repr(OmegaConf.to_container(composed, resolve=False)))
            trials.append(resolve_trial(composed, overrides))
        if not reads_seed:
            by_settings[without_seed] = trials[-1]
    return trials


def resolve_times(sweep: DictConfig) -> None:
    """Resolve the settings of a sweep once, so that ``${now:…}`` is the same time for all its trials."""
    for key in [str(key) for key in sweep if key != "hydra"]:
        with suppress(OmegaConfBaseException):  # such as a setting that only the words of a job set
            if OmegaConf.is_config(sweep[key]):
                OmegaConf.to_container(sweep[key], resolve=True)


def typed_words(overrides: DictConfig) -> tuple[list[str], list[str]]:
    """The typed words in a node ``hydra.overrides``: those for Hydra, and those for gsbench."""
    words: Any = OmegaConf.to_container(overrides, resolve=False)
    return [word for word in words["hydra"] if word.partition("=")[0] not in ADDED], words["task"]


def with_seed(trial: Trial, seed: int) -> Trial:
    """The same trial with another seed. Only for a trial whose other settings do not read the seed."""
    seed = check_values(Config, {"seed": seed}, "")["seed"]
    words = tuple(f"seed={seed}" if word.startswith("seed=") else word for word in trial.overrides)
    return replace(trial, values=trial.values | {"seed": seed}, overrides=words)


def _plain_values(words: Sequence[str]) -> Mapping[str, Any]:
    """Numbers and texts that words give to settings; empty if the order of the words may matter."""
    keys = [key for key in map(_key, words) if "." in key]
    parents = {key[:dot] for key in keys for dot in range(len(key)) if key[dot] == "."}
    if len(set(keys)) < len(keys) or parents & set(keys) or any(map(_is_mapping, words)):
        return {}
    return {key: value for key, value in map(_key_and_value, words) if PLAIN_KEY.fullmatch(key) and _is_plain(value)}


@cache
def _key_and_value(word: str) -> tuple[str, Any]:
    """The key of a word, with the signs ``+`` and ``~``, and the value as Hydra reads it."""
    override = parse_word(word)
    return word.partition("=")[0], None if override.is_sweep_override() else override.value()


def _key(word: str) -> str:
    return _key_and_value(word)[0].lstrip("+~")


def _is_mapping(word: str) -> bool:
    return isinstance(_key_and_value(word)[1], dict)


def _is_plain(value: object) -> bool:
    return isinstance(value, int | float) or (isinstance(value, str) and "$" not in value)
