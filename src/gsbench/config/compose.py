"""Configurations as Hydra composes them, looked at as a whole, and made ready for trials."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import hydra
import yaml
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from gsbench.config.command_words import (
    GROUPS,
    check_search_path,
    check_single,
    is_sweep,
    options,
    searched_folders,
    typed_permissions,
)
from gsbench.config.hydra_entry import CONFIG_NAME, explained, hydra_ready
from gsbench.config.schema import check, plain
from gsbench.config.trust import PERMISSIONS, check_composed, check_permissions
from gsbench.errors import InputError
from gsbench.parsing import LOADER, MOST_VALUES
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.own_modules import allow_modules


@dataclass(frozen=True)
class Trial:
    """A trial as it is asked for: its resolved values, the overrides that give them, and where its files lie.

    One that was ``recorded`` is read from its own ``config.yaml``, and no overrides give it. Raises InputError for
    values that would make run what their ``allow_targets`` does not name, wherever they come from.
    """

    values: dict[str, Any]
    overrides: tuple[str, ...]
    recorded: bool = False

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
    with explained(overrides):
        return checked_trial(without_hydra(config), overrides)


def checked_trial(config: DictConfig, overrides: Sequence[str]) -> Trial:
    """The trial of a configuration without Hydra's node, whose values are checked, and converted in place."""
    with explained(overrides):  # such as an interpolation that leads nowhere
        check(config)
        return Trial(plain(config), tuple(overrides))


def without_hydra(config: DictConfig) -> DictConfig:
    """The trial's part of a composed configuration: a copy without Hydra's own node ``hydra``."""
    trial = copy.deepcopy(config)
    if "hydra" in trial:  # else Hydra has taken it already: it runs the job
        with open_dict(trial):
            del trial["hydra"]
    return trial


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
