"""The trials of a sweep, from the words of each.

Hydra takes a tenth of a second for a composition, and a sweep may have ten thousand trials; so what their words have in
common is composed once. In Hydra's order values come after the files that groups choose: trials that choose the same
files share those, and trials that differ in the seed alone share all else.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from typing import Any

from hydra.core.config_loader import ConfigLoader
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsbench.config.command_words import check_search_path, parse_word
from gsbench.config.compose import Trial, checked_trial, look_at, without_hydra
from gsbench.config.hydra_entry import explained
from gsbench.config.schema import Config
from gsbench.settings import checked

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
                composed = without_hydra(look_at(loader.load_sweep_config(sweep, list(words)), allowed))
                by_files[files] = copy.deepcopy(composed)
            asks = MAY_ASK_FOR_SEED.search(repr(OmegaConf.to_container(composed, resolve=False)))
            trials.append(checked_trial(composed, given))
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
