"""The trials of a sweep: what their words have in common is composed once.

Hydra takes a tenth of a second for a composition, and a sweep may have ten thousand jobs. In Hydra's order values come
after the files that groups choose, so jobs that choose the same files share those; jobs that differ in the seed alone
share all else.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf

from gsbench.config.command_words import parse_word
from gsbench.config.compose import Composed, asks_hydra, explained, raw_text, resolved, settle, without_hydra
from gsbench.config.hydra_job import HydraJob, number_job, words_of
from gsbench.config.schema import Config, check
from gsbench.settings import checked

SEED = re.compile(r"seed=(\d+)")
# The seed, and settings of groups but for those that name a class (``_target_``).
PLAIN_KEY = re.compile(r"seed|(?!hydra\b)[a-zA-Z]\w*(\.[a-zA-Z]\w*)+")
# Text that may ask for the seed: by its name, or by one that is made when it is asked for.
MAY_ASK_FOR_SEED = re.compile(r"\$\{[^}]*(seed|\$\{)")


@dataclass(frozen=True)
class _Base:
    """Part that jobs share that choose the same files: a trial's part of a composition, before any check."""

    config: DictConfig
    for_any_seed: bool  # whether the other settings are the same for all


def compose_jobs(
    context: HydraContext, master: DictConfig, jobs: Sequence[Sequence[str]], first: int = 0
) -> list[Composed]:
    """The trials of a sweep from the words of each.

    A composition stays with the job that it was made for; the job of a trial that shares it has none yet.
    """
    by_files: dict[tuple[str, ...], _Base] = {}
    by_settings: dict[tuple[str, ...], Composed] = {}
    trials = []
    for_hydra, _ = words_of(master.hydra.overrides)
    for number, words in enumerate(jobs, first):
        given = (*for_hydra, *words)
        job = HydraJob(None, tuple(words), number, master, context.config_loader, context.callbacks)
        seeds = [int(match.group(1)) for word in words if (match := SEED.fullmatch(word))]
        others = tuple(word for word in words if not SEED.fullmatch(word))
        if seeds and others in by_settings:
            trials.append(replace(with_seed(by_settings[others], seeds[-1]), overrides=given, job=job))
            continue
        values = _plain_values(words)
        files = (*(word for word in words if word.partition("=")[0] not in values), *values)
        base = by_files.get(files)
        if base is None:
            with explained(given):
                config = context.config_loader.load_sweep_config(master, list(words))
            number_job(config, number)
            trial = settle(config, given)
            trials.append(resolved(trial, given, replace(job, config=config)))
            if asks_hydra(trial):
                continue
            base = _Base(without_hydra(config), not MAY_ASK_FOR_SEED.search(raw_text(trial)))
            by_files[files] = base
        else:
            trial = copy.deepcopy(base.config)
            with explained(given):
                for key, value in values.items():
                    OmegaConf.update(trial, key, value)
                check(trial)
            trials.append(resolved(trial, given, job))
        if base.for_any_seed:
            by_settings[others] = trials[-1]
    return trials


def with_seed(trial: Composed, seed: int) -> Composed:
    """The same trial with another seed, for one whose other settings do not ask for it."""
    seed = checked(Config, {"seed": seed}, "")["seed"]
    words = tuple(f"seed={seed}" if word.startswith("seed=") else word for word in trial.overrides)
    text = trial.yaml.replace(f"\nseed: {trial.values['seed']}\n", f"\nseed: {seed}\n", 1)
    return replace(trial, values=trial.values | {"seed": seed}, yaml=text, overrides=words)


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
