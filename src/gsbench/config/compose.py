"""Compose the configurations of a command with Hydra, and make its trials.

Words go one way: Hydra composes once for each choice of groups, the values of single settings are
set in a copy, and the resolved copy is checked: a trial.
"""

import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from gsbench.config.command_words import check_single, typed_permissions, typed_readings
from gsbench.config.explain import explained, not_a_setting
from gsbench.config.groups import GROUPS
from gsbench.config.overrides import bare_key, is_sweep, key_of, parse_word, task_words
from gsbench.config.schema import ROOT_SETTINGS, Config, check, plain, register_schemas
from gsbench.config.search_path import (
    check_choice,
    check_search_path,
    permitted_to_files,
    read_by_gsbench,
)
from gsbench.config.trust import MADE_NODES, check_composed, check_permissions, check_texts
from gsbench.errors import InputError
from gsbench.runs.code import PERMISSIONS
from gsbench.runs.trial_folder import TrialFolder
from gsbench.settings import check_values
from gsbench.system.install import conf_dir
from gsbench.system.programs import allow_modules
from gsbench.train.options import BY_AUTOGRAD

CONFIG_NAME = "config"  # conf/config.yaml
# Hydra 1.3 warns unless it is told which version's defaults hold; Hydra 1.4 has one set and warns
# if it is told.
VERSION_BASE: dict[str, Any] = (
    {"version_base": "1.3"} if hydra.__version__.startswith("1.3.") else {}
)
MADE_GROUPS = tuple(f"hydra/{name}" for name in MADE_NODES)
# stands for the seed while settings are resolved that all seeds share: reading it is an error
ANY_SEED = "${no_seed}"


# ---- Hydra, set up with gsbench's files


@cache
def installed_nodes(choices: tuple[str, ...]) -> Mapping[str, Any]:
    """Hydra's node for ``choices`` of plug-ins and logs, from installed packages only.

    It includes what gsbench's own ``conf/config.yaml`` sets. Choices that only a user's folder has
    are left out.
    """
    with hydra_ready():
        known = [
            word
            for word in choices
            if word.partition("=")[2] in config_loader().get_group_options(word.partition("=")[0])
        ]
    node = composed_once(tuple(known)).hydra
    return OmegaConf.to_container(node, resolve=False)  # type: ignore[return-value]


@cache
def composed_once(words: tuple[str, ...]) -> DictConfig:
    """Hydra's composition of ``words``, with its node; do not change it.

    Only for words that name no folder of the user's: gsbench's own files stay as they are while a
    process runs.
    """
    with hydra_ready():  # composing takes 0.1 s
        return hydra.compose(CONFIG_NAME, list(words), return_hydra_config=True)


@contextmanager
def hydra_ready() -> Iterator[None]:
    """Initialise Hydra with gsbench's configuration folder within the block."""
    register_schemas()
    if GlobalHydra.instance().is_initialized():  # within `hydra.main`, or in a block of this kind
        yield
        return
    with hydra.initialize_config_dir(str(conf_dir()), job_name="gsbench", **VERSION_BASE):
        yield


def config_loader() -> ConfigLoader:
    """Hydra's loader of configurations. Call it within `hydra_ready`."""
    return GlobalHydra.instance().config_loader()


@contextmanager
def hydra_config(config: DictConfig | None) -> Iterator[None]:
    """Let ``${hydra:…}`` read the node of ``config`` within the block; with None it is an error."""
    instance = HydraConfig.instance()
    before, instance.cfg = instance.cfg, None
    try:
        if config is not None:
            instance.set_config(config)
        yield
    finally:
        instance.cfg = before


# ---- the trials of a command


@dataclass(frozen=True)
class Trial:
    """A requested trial: its resolved values, the overrides behind them, and its folder.

    A trial that is read from its own ``config.yaml`` has no overrides. Raises InputError for values
    that would run code or programs that their ``allow_targets`` does not name.
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


class Composer:
    """Composes the configurations and the trials of one command.

    ``config`` is the whole configuration of the words that list no values, with Hydra's node and
    without settings of groups whose choices are listed. Only the words ``typed`` by the user
    (default: all ``words``) give permissions. From here on Python finds the modules that are
    allowed in the folder ``modules`` (default: the current one).
    Raises InputError with one line.
    """

    def __init__(
        self,
        words: Sequence[str],
        typed: Sequence[str] | None = None,
        modules: str | None = None,
    ) -> None:
        # The order matters: Hydra imports packages of the search path while it composes, so they
        # are checked first.
        self.typed = words if typed is None else typed
        self.allowed = typed_permissions(self.typed) + typed_readings(self.typed)
        allow_modules(self.allowed, modules)
        check_search_path(words, self.allowed)
        single = [word for word in words if not is_sweep(word)]
        own = task_words(single)
        self.hydra_words = tuple(word for word in single if word not in own)
        self._check_words(single)  # before any of them is resolved
        self._chosen: dict[tuple[str, ...], DictConfig] = {}
        self._times: dict[str, Any] = {}  # what ${now:…} stands for, the same in all trials
        # The settings of a group whose choices are listed, here or in a file, are checked with each
        # choice.
        listed = set(map(key_of, words)) - set(map(key_of, single))
        listed |= _swept_groups(self._choose(own).hydra.sweeper)
        values = [word for word in own if key_of(word).partition(".")[0] not in listed]
        self.config = self.settings(values)
        with explained(words):
            is_sent = self.config.tracking.get("uri")
        if is_sent:
            with permitted_to_files(self.allowed):
                self.allowed += typed_address(self.typed)
            self.config[PERMISSIONS] = list(self.allowed)
        with open_dict(self.config):
            self.config.hydra = self._choose(values).hydra
            self.config.hydra.runtime.cwd = os.getcwd()

    def settings(self, words: Sequence[str]) -> DictConfig:
        """The configuration of ``words`` without Hydra's node; trials check what it may run."""
        self._check_words(words)
        chosen = self._choose(words)
        config = OmegaConf.masked_copy(chosen, [str(key) for key in chosen if key != "hydra"])
        OmegaConf.set_struct(config, True)
        with explained(words):
            for word in filter(_is_value, words):
                set_value(config, parse_word(word))
        config[PERMISSIONS] = list(self.allowed)  # any in a file counts nothing
        return config

    def has_key(self, key: str) -> bool:
        """Return whether the whole configuration has a value for the dotted ``key``."""
        return OmegaConf.select(self.config, key) is not None

    def trials(self, jobs: Sequence[Sequence[str]]) -> list[Trial]:
        """The trials of ``jobs``, each the list of its words.

        Jobs that differ only in the seed are resolved once, unless a setting reads the seed.
        """
        any_seed: dict[tuple[str, ...], Trial | None] = {}
        trials = []
        for number, words in enumerate(jobs):
            others, seed = _without_seed(words)
            if others not in any_seed:
                any_seed[others] = self._trial(words, others, seed)
            trial = any_seed[others]
            if trial is None:
                again = None if seed is None else self._trial(words, words)
                trial = again or self._trial_of_hydra(words, number)
            trials.append(trial if seed is None else with_seed(trial, seed))
        # Times compare ideas only if all arms train in the same way: if a setting or a part of one
        # needs steps of plain autograd, all take them.
        asking = (BY_AUTOGRAD, "loss", "terms", "optimizer")
        if len({any(map(trial.values["train"].get, asking)) for trial in trials}) > 1:
            return self.trials([[*words, f"train.{BY_AUTOGRAD}=true"] for words in jobs])
        return trials

    def trial(self, overrides: Sequence[str]) -> Trial:
        """The single trial of the command's words, which are its ``overrides``."""
        words = task_words(overrides)
        trial = self._trial(words, words) or self._trial_of_hydra(words)
        return replace(trial, overrides=tuple(overrides))

    def keep_times(self, config: DictConfig) -> None:
        """Let ``${now:…}`` in ``config`` stand for what it stands for in the trials."""
        OmegaConf.set_cache(config, defaultdict(dict, now=self._times))

    def _trial(
        self, words: Sequence[str], others: Sequence[str], seed: int | None = None
    ) -> Trial | None:
        """The trial of ``words``, which are the ``others`` and the ``seed``.

        None if a setting reads this seed, or Hydra's node.
        """
        config = self.settings(others)
        if seed is not None:
            config.seed = ANY_SEED
        # Reading `ANY_SEED` or the missing node raises; so does a fault, which Hydra's composition
        # then names.
        with suppress(OmegaConfBaseException):
            return self._checked(config, None, words, {} if seed is None else {"seed": seed})
        return None

    def _trial_of_hydra(self, words: Sequence[str], number: int | None = None) -> Trial:
        """The trial of ``words`` as Hydra composes its job, with its number and its node."""
        with hydra_ready(), explained(words):
            config = self._composed(words)
            with open_dict(config):
                config[PERMISSIONS] = list(self.allowed)
                config.hydra.mode = self.config.hydra.mode
                if number is not None:  # of a job of a sweep
                    config.hydra.job.num, config.hydra.job.id = number, f"job_id_for_{number}"
            return self._checked(config, config, words, {})

    def _checked(
        self,
        config: DictConfig,
        hydras: DictConfig | None,
        words: Sequence[str],
        given: Mapping[str, Any],
    ) -> Trial:
        self.keep_times(config)
        with hydra_config(hydras):
            values = plain(config, given)
        self._times = OmegaConf.get_cache(config)["now"]
        return Trial(check(values), (*self.hydra_words, *words))

    def _choose(self, words: Sequence[str]) -> DictConfig:
        """Hydra's composition of the choices among ``words``, checked; do not change it."""
        # of two words for one group, with the same signs, the later one counts
        choices = {
            parse_word(word).get_key_element(): word for word in words if not _is_value(word)
        }
        key = tuple(choices.values())
        if key not in self._chosen:
            with hydra_ready():
                self._chosen[key] = self._compose(key, words)
        return self._chosen[key]

    def _compose(self, choices: Sequence[str], words: Sequence[str]) -> DictConfig:
        folders = read_by_gsbench(
            [word for word in self.hydra_words if key_of(word) == "hydra.searchpath"]
        )
        for choice in choices:
            key = key_of(choice)
            group = key.partition("@")[0]
            if group not in GROUPS and not config_loader().get_group_options(
                group, None, CONFIG_NAME, folders
            ):
                raise InputError(not_a_setting(key, self._choose([]), words))
            check_choice(choice, str(parse_word(choice).value()))
        with explained([*self.hydra_words, *words]):
            if not self.hydra_words:  # all files are gsbench's own
                return composed_once(tuple(choices))
            config = self._composed(choices)
        # for the check, which tells what is in a word from what a file sets
        config.hydra.overrides.task = list(map(key_of, words))
        check_permitted(config, self.allowed)
        return config

    def _composed(self, words: Sequence[str]) -> DictConfig:
        """Hydra's composition, for which gsbench reads the files of the user's folders."""
        with permitted_to_files(self.allowed):
            return hydra.compose(
                CONFIG_NAME,
                [*read_by_gsbench(self.hydra_words), *words],
                return_hydra_config=True,
            )

    def _check_words(self, words: Sequence[str]) -> None:
        """Refuse words that would resolve what is not allowed, and Hydra's own choices of files.

        Choices in other groups are checked in `_compose`, which knows the groups.
        """
        for word in words:
            override = parse_word(word)
            value: Any = override.value()
            *place, name = override.key_or_group.split(".")
            check_texts({name: value}, self.allowed, ".".join(place))
            if word in self.hydra_words and not _is_value(word):
                check_choice(word, str(value))


def _swept_groups(sweeper: DictConfig) -> set[str]:
    """The groups of which a sweep in a file lists choices or settings."""
    raw: Any = OmegaConf.to_container(sweeper, resolve=False)
    grids = raw.get("grids")
    nodes = [raw.get("params"), *(grids if isinstance(grids, list) else ())]
    keys = chain(*(node for node in nodes if isinstance(node, dict)))
    return {bare_key(str(key)).partition(".")[0] for key in keys}


def _is_value(word: str) -> bool:
    """Return whether a word sets a value, instead of choosing a file of a group."""
    override = parse_word(word)
    key = override.key_or_group
    return "." in key or key in ROOT_SETTINGS or isinstance(override.value(), dict)


def _without_seed(words: Sequence[str]) -> tuple[tuple[str, ...], int | None]:
    """The words without the seed, and the seed; all words and None unless it is a plain number."""
    seeds = [word for word in words if key_of(word) == "seed"]
    if len(seeds) == 1 and seeds[0].startswith("seed="):
        seed: Any = parse_word(seeds[0]).value()
        if isinstance(seed, int):
            return tuple(word for word in words if word != seeds[0]), seed
    return tuple(words), None


def set_value(config: DictConfig, override: Override) -> None:
    """Set, add or remove a setting, as Hydra does.

    Raises InputError for a setting that is added twice or removed without being there, and
    OmegaConf's errors for one that does not exist.
    """
    key, word, value = override.key_or_group, override.input_line, override.value()
    is_added = override.is_add()
    present = OmegaConf.select(config, key) if is_added or override.is_delete() else None
    if override.is_delete():
        parent, _, name = key.rpartition(".")
        if present is None or value not in (None, present):
            raise InputError(f"{word}: there is no {key}{'' if value is None else f'={value}'}")
        with open_dict(config):
            del OmegaConf.select(config, parent)[name]
    elif is_added and present is not None and not isinstance(value, dict | list):
        raise InputError(f"{word}: {key} has a value already: leave out the plus to replace it")
    else:
        OmegaConf.update(config, key, value, force_add=is_added or override.is_force_add())


def check_permitted(config: DictConfig, allowed: Sequence[str]) -> None:
    """Run `check_composed` against Hydra's nodes as the installed packages write them."""
    choices = config.hydra.runtime.choices
    made = tuple(f"{group}={choices[group]}" for group in MADE_GROUPS)
    check_composed(config, allowed, installed_nodes(made))


def compose_one(
    overrides: Sequence[str], typed: Sequence[str] | None = None, modules: str | None = None
) -> Trial:
    """The single trial that ``overrides`` describe; `Composer` says what the others mean."""
    check_single(overrides, "choose one")
    return Composer(overrides, typed, modules).trial(overrides)


def typed_address(typed: Sequence[str]) -> tuple[str, ...]:
    """The tracker's address that the ``typed`` words about tracking give by themselves, if any."""
    # Composed from these words alone: whatever else sets the address, such as a file of somebody
    # else's, could send results and a password there.
    about_tracking = ("tracking", "hydra.searchpath")
    words = [word for word in typed if key_of(word).startswith(about_tracking)]
    with hydra_ready(), explained(words):
        config = hydra.compose(CONFIG_NAME, read_by_gsbench(words))
        return (str(config.tracking.uri),) if config.tracking.get("uri") else ()


def with_seed(trial: Trial, seed: int) -> Trial:
    """The same trial with another seed.

    Only for a trial whose other settings do not read the seed.
    """
    seed = check_values(Config, {"seed": seed}, "")["seed"]
    words = tuple(f"seed={seed}" if word.startswith("seed=") else word for word in trial.overrides)
    return replace(trial, values=trial.values | {"seed": seed}, overrides=words)
