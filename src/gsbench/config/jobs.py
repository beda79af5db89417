"""The trials of a sweep, and each of them as a job of Hydra's.

Hydra takes a tenth of a second for a composition, and a sweep may have ten thousand jobs; so what their words have in
common is composed once. In Hydra's order values come after the files that groups choose: jobs that choose the same
files share those, and jobs that differ in the seed alone share all else.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from hydra.core.utils import run_job, setup_globals
from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from gsbench.config.command_words import check_search_path, parse_word
from gsbench.config.compose import (
    Trial,
    asks_hydra,
    checked_config,
    look_at,
    raw_text,
    resolved,
    without_hydra,
)
from gsbench.config.hydra_entry import hydra_ready
from gsbench.config.messages import explained
from gsbench.config.schema import Config, check
from gsbench.errors import InputError
from gsbench.logs import show_details
from gsbench.settings import checked
from gsbench.system.own_modules import allowed_modules, take_over

OWN_FOLDER = "${runs}/.hydra"  # of Hydra's files of a sweep, as conf/config.yaml has it
ADDED = ("hydra.mode", "hydra.sweeper.grids")  # settings that `gsbench.app.command` adds to those that were typed
Result = TypeVar("Result")
SEED = re.compile(r"seed=(\d+)")
# The seed, and settings of groups but for those that name a class (``_target_``).
PLAIN_KEY = re.compile(r"seed|(?!hydra\b)[a-zA-Z]\w*(\.[a-zA-Z]\w*)+")
# Text that may ask for the seed: by its name, or by one that is made when it is asked for.
MAY_ASK_FOR_SEED = re.compile(r"\$\{[^}]*(seed|\$\{)")


class JobContext(HydraContext):
    """Hydra's context, which in another process first lets the user's modules be found: callbacks may be of them."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _context_of, (_Modules(allowed_modules()), self.config_loader, self.callbacks)


class _Modules:
    """The modules that were allowed; another process allows them when it unpickles this."""

    def __init__(self, folders: Mapping[str, str]) -> None:
        self.folders = dict(folders)

    def __reduce__(self) -> tuple[Any, ...]:
        return take_over, (self.folders,)


def _context_of(_: None, loader: Any, callbacks: Any) -> JobContext:
    return JobContext(loader, callbacks)


@dataclass(frozen=True)
class HydraJob:
    """A trial as job ``number`` of a ``sweep``, by its ``words``: in this process or, pickled, in another.

    ``has_effect`` tells whether anybody notices that Hydra runs it: else a trial need not carry the whole sweep along.
    """

    context: HydraContext
    sweep: DictConfig
    words: tuple[str, ...]
    number: int
    has_effect: bool = True

    def composed(self) -> DictConfig:
        """The job's configuration with the node ``hydra``; raises InputError for what was not allowed."""
        allowed = tuple(self.sweep.allow_targets)
        check_search_path(self.words, allowed)
        config = self.context.config_loader.load_sweep_config(self.sweep, list(self.words))
        with read_write(config.hydra), open_dict(config.hydra):
            config.hydra.job.num = self.number
            config.hydra.job.id = str(self.number)
        return look_at(config, allowed)

    def run(self, work: Callable[[], Result], value_of: Callable[[Result], object]) -> Result:
        """Do ``work`` as Hydra runs a job; ``value_of`` its result is what callbacks are told. Raises what it raises.

        Hydra would hand an error back in place of a result, and write a line of its own on looking at it.
        """
        ended: list[Result] = []
        errors: list[Exception] = []

        def task(_: DictConfig) -> object:
            try:
                ended.append(work())
            except Exception as error:
                errors.append(error)
                raise
            return value_of(ended[0])

        with hydra_ready():
            setup_globals()  # the resolvers, in a process where nothing was composed
            config = self.composed()
            show_details(config.hydra.verbose)
            run_job(
                task,
                config,
                "hydra.sweep.dir",
                "hydra.sweep.subdir",
                hydra_context=self.context,
                configure_logging=False,
            )
        if errors:
            raise errors[0]
        return ended[0]


@dataclass(frozen=True)
class _Base:
    """Part that jobs share that choose the same files: a trial's part of a composition, before any check."""

    config: DictConfig
    for_any_seed: bool  # whether the other settings are the same for all
    has_effect: bool  # of `HydraJob`


def compose_jobs(
    context: HydraContext, sweep: DictConfig, jobs: Sequence[Sequence[str]], first: int = 0
) -> list[Trial]:
    """The trials of a ``sweep`` from the words of each, numbered from ``first`` on."""
    by_files: dict[tuple[str, ...], _Base] = {}
    by_settings: dict[tuple[str, ...], Trial] = {}
    trials = []
    for_hydra = typed(sweep.hydra.overrides)[0]
    for number, words in enumerate(jobs, first):
        given = (*for_hydra, *words)
        job = HydraJob(context, sweep, tuple(words), number)
        seeds = [int(match.group(1)) for word in words if (match := SEED.fullmatch(word))]
        others = tuple(word for word in words if not SEED.fullmatch(word))
        if seeds and others in by_settings:
            like = by_settings[others]
            assert like.job is not None
            job = replace(job, has_effect=like.job.has_effect)
            trials.append(replace(with_seed(like, seeds[-1]), overrides=given, job=job))
            continue
        values = _plain_values(words)
        files = (*(word for word in words if word.partition("=")[0] not in values), *values)
        base = by_files.get(files)
        if base is None:
            with explained(given):
                config = job.composed()
            job = replace(job, has_effect=_has_effect(config))
            trial = checked_config(config, given)
            trials.append(resolved(trial, given, job))
            if asks_hydra(trial):
                continue
            base = _Base(without_hydra(config), not MAY_ASK_FOR_SEED.search(raw_text(trial)), job.has_effect)
            by_files[files] = base
        else:
            job = replace(job, has_effect=base.has_effect)
            trial = copy.deepcopy(base.config)
            with explained(given):
                for key, value in values.items():
                    OmegaConf.update(trial, key, value)
                check(trial)
            trials.append(resolved(trial, given, job))
        if base.for_any_seed:
            by_settings[others] = trials[-1]
    return trials


def _has_effect(config: DictConfig) -> bool:
    """Return whether Hydra's own settings of a job do more than to run it."""
    raw: Any = OmegaConf.to_container(config.hydra, resolve=False)
    folders = [raw["sweep"]["dir"], raw["sweep"]["subdir"], raw["output_subdir"]]
    said = raw["callbacks"] or raw["job"]["env_set"] or raw["verbose"]
    return bool(said) or folders != [OWN_FOLDER, ".", None]


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


# ---- Hydra's folders


def begin_sweep(sweep: DictConfig, record: bool) -> None:
    """Resolve every ``${now:…}`` of a sweep, so that its jobs, which take over what is resolved, have one time.

    ``record``: write ``multirun.yaml``, Hydra's record of a sweep, to a ``hydra.sweep.dir`` that is not gsbench's own.
    """
    for place, value in _texts(OmegaConf.to_container(sweep, resolve=False)):
        if "${now:" in value:
            with suppress(OmegaConfBaseException):  # such as a part that only a job knows
                OmegaConf.select(sweep, place)
    raw: Any = OmegaConf.to_container(sweep.hydra.sweep, resolve=False)
    if record and raw["dir"] != OWN_FOLDER:
        folder = Path(str(sweep.hydra.sweep.dir))
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(sweep, folder / "multirun.yaml")


def _texts(values: Any, place: str = "") -> Iterator[tuple[str, str]]:
    """The texts at any depth, each with the key that leads to it; keys of other forms than OmegaConf's are left out."""
    if isinstance(values, str) and place:
        yield place, values
    elif isinstance(values, dict | list):
        for key, value in values.items() if isinstance(values, dict) else enumerate(values):
            if re.fullmatch(r"[\w/-]+", str(key)):
                yield from _texts(value, f"{place}.{key}" if place else str(key))


def check_output_folder(config: DictConfig, multirun: bool) -> None:
    """Refuse a folder for Hydra's own files that cannot be made, before any work.

    One whose name only a job knows is left to that job, and gsbench's own lies in the runs folder, which is looked at
    by who fills it, or finds all done there.
    """
    keys = ("hydra.sweep.dir", "hydra.sweep.subdir") if multirun else ("hydra.run.dir",)
    raw: Any = OmegaConf.to_container(config.hydra, resolve=False)
    given = [raw["sweep"]["dir"], raw["sweep"]["subdir"]] if multirun else [raw["run"]["dir"]]
    if given in ([OWN_FOLDER, "."], ["."]):
        return
    try:
        folder = Path(*(str(OmegaConf.select(config, key)) for key in keys)).absolute()
    except OmegaConfBaseException:
        return
    try:
        existing = next(place for place in (folder, *folder.parents) if place.exists())
        with TemporaryDirectory(prefix=".probe-", dir=existing):
            pass
    except (OSError, ValueError) as error:
        raise InputError(
            f"{' and '.join(keys)}: {folder} cannot be made ({getattr(error, 'strerror', None) or error})"
        ) from None
