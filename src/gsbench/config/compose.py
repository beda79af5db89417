"""Compose and check the configuration of a command line with Hydra, and make its trials.

Also runs gsbench as a Hydra app, and rewrites Hydra's errors as one line.
"""

import copy
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import (
    AbstractContextManager,
    contextmanager,
    nullcontext,
    redirect_stderr,
    suppress,
)
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import hydra
import hydra.utils
import yaml
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from gsbench.config import command_words
from gsbench.config.command_words import GROUPS, options, parse_word
from gsbench.config.schema import Config, checked_values, register_schemas
from gsbench.config.trust import (
    HYDRAS_CALLBACKS,
    MADE_NODES,
    PERMISSIONS,
    check_composed,
    check_permissions,
)
from gsbench.errors import GsbenchError, InputError
from gsbench.parsing import MAX_VALUES
from gsbench.runs.nested import targets_in
from gsbench.runs.trial_folder import TrialFolder
from gsbench.settings import check_values
from gsbench.system.install import conf_dir
from gsbench.system.own_modules import allow_modules
from gsbench.words import did_you_mean

CONFIG_NAME = "config"  # conf/config.yaml
# Hydra 1.3 warns unless it is told which version's defaults hold; Hydra 1.4 has one set and warns
# if it is told.
VERSION_BASE: dict[str, Any] = (
    {"version_base": "1.3"} if hydra.__version__.startswith("1.3.") else {}
)
# Within this context, Hydra 1.4 and later instantiates only the named classes (``mine.*``: all of a
# module).
WHITELIST: Callable[[Sequence[str]], AbstractContextManager[Any]] = getattr(
    hydra.utils, "execution_whitelist", lambda names: nullcontext()
)
MADE_GROUPS = tuple(f"hydra/{name}" for name in MADE_NODES)
HYDRAS_LINE = "Error executing job with overrides"


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


def compose_whole(
    words: Sequence[str], typed: Sequence[str] | None = None, modules: str | None = None
) -> DictConfig:
    """Compose the configuration of ``words`` with Hydra's node, and check what it may run.

    Only the words ``typed`` by the user (default: all ``words``) give permissions. Words that list
    several values are left out. From here on Python finds the modules that are allowed in the
    folder ``modules`` (default: the current one). Raises InputError with one line. Call it within
    `hydra_ready`.
    """
    # The order matters: Hydra imports packages of the search path while it composes, so they are
    # checked first.
    typed = words if typed is None else typed
    allowed = command_words.typed_permissions(typed)
    command_words.check_search_path(words, allowed)
    check_files(command_words.searched_folders(words))
    allow_modules(allowed, os.getcwd() if modules is None else modules)
    with explained(words), warnings.catch_warnings():
        # Hydra only warns of a folder in its search path that does not exist.
        warnings.filterwarnings("error", message=r".* is not available\.", module="hydra")
        single = [word for word in words if not command_words.is_sweep(word)]
        config = hydra.compose(CONFIG_NAME, single, return_hydra_config=True)
        if config.tracking.get("uri"):
            allowed += typed_address(typed)
        return enforce_permissions(config, allowed)


def typed_address(typed: Sequence[str]) -> tuple[str, ...]:
    """The tracker's address that the ``typed`` words about tracking give by themselves, if any."""
    own = ("tracking", "hydra.searchpath")
    words = [word for word in typed if command_words.key_of(word).startswith(own)]
    config = hydra.compose(CONFIG_NAME, words)
    return (str(config.tracking.uri),) if config.tracking.get("uri") else ()


def check_files(folders: Sequence[Path]) -> None:
    """Refuse a file of the user's ``folders`` whose YAML aliases stand for too many values.

    A few lines of nested aliases can stand for billions of values ("billion laughs"), and Hydra
    would expand them.
    """
    files: list[Path] = []
    for folder in folders:
        for pattern in ("*.yaml", "*/*.yaml", "*/*/*.yaml"):
            files += folder.glob(pattern)
    for file in files:
        try:
            text = file.read_text(encoding="utf-8") if file.is_file() else ""
            if "*" not in text:
                continue
            # The loader in Python raises RecursionError for deep nesting; that in C would crash.
            count = _expanded_size(yaml.compose(text, Loader=yaml.SafeLoader), {})
        # Hydra reports it if it reads the file
        except (OSError, ValueError, RecursionError, yaml.YAMLError):
            continue
        if count > MAX_VALUES:
            raise InputError(f"{file}: its aliases stand for more than {MAX_VALUES:,} values")


def _expanded_size(node: yaml.Node | None, sizes: dict[int, int]) -> int:
    """The number of values in a YAML node after each alias is replaced by what it names.

    ``sizes`` keeps the numbers that are known, by the id of the node.
    """
    if id(node) not in sizes:
        sizes[id(node)] = 1  # counts where an alias stands for a mapping or list that contains it
        parts = node.value if isinstance(node, yaml.CollectionNode) else []
        if isinstance(node, yaml.MappingNode):
            parts = chain(*parts)  # keys and values
        sizes[id(node)] = 1 + sum(_expanded_size(part, sizes) for part in parts)
    return sizes[id(node)]


def enforce_permissions(config: DictConfig, allowed: Sequence[str]) -> DictConfig:
    """Refuse a configuration that would run what is not ``allowed``, and set ``allow_targets``.

    This discards any ``allow_targets`` from a file.
    """
    check_permitted(config, allowed)
    with read_write(config), open_dict(config):
        config[PERMISSIONS] = list(allowed)
    return config


def check_permitted(config: DictConfig, allowed: Sequence[str]) -> None:
    """Run `check_composed` against Hydra's nodes as the installed packages write them."""
    choices = config.hydra.runtime.choices if "hydra" in config else {}
    words = [
        f"{group}={choice}"
        for group, choice in sorted(choices.items())
        if str(group).startswith(MADE_GROUPS)
    ]
    check_composed(config, allowed, installed_nodes(tuple(words)))


@cache
def installed_nodes(words: tuple[str, ...]) -> Mapping[str, Any]:
    """Hydra's node for the choices ``words``, from installed packages only.

    It includes what gsbench's own ``conf/config.yaml`` sets. Choices from a user's folder are left
    out.
    """
    with hydra_ready():
        try:
            config = hydra.compose(CONFIG_NAME, list(words), return_hydra_config=True)
        except (HydraException, OmegaConfBaseException):
            if len(words) < 2:
                return installed_nodes(())
            # One by one, so that a choice that no package has does not drop the others.
            nodes: dict[str, Any] = {}
            for word in words:
                own = installed_nodes((word,))
                nodes |= {name: own[name] for name in own if name in word}
            return nodes
        return OmegaConf.to_container(config.hydra, resolve=False)  # type: ignore[return-value]


def compose_one(
    overrides: Sequence[str], typed: Sequence[str] | None = None, modules: str | None = None
) -> Trial:
    """The single trial that ``overrides`` describe; `compose_whole` says what the others mean."""
    command_words.check_single(overrides, "choose one")
    with hydra_ready():
        return resolve_trial(compose_whole(overrides, typed, modules), overrides)


def resolve_trial(config: DictConfig, overrides: Sequence[str]) -> Trial:
    """The trial of a composed configuration, with interpolations resolved in a copy."""
    if "hydra" in config:  # for ${hydra:…} among the settings
        HydraConfig.instance().set_config(config)
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
# Hydra takes a tenth of a second for a composition, and a sweep may have ten thousand trials. So
# what trials share is composed once. Hydra applies values after the files that groups choose.
# Trials that choose the same files share their composition, and trials that differ only in the seed
# share the resolved values too.

# settings that `gsbench.app.command` adds to the typed ones
ADDED = ("hydra.mode", "hydra.sweeper.grids")
SEED = re.compile(r"seed=(\d+)")
# The seed, or a setting of a group, except settings that name a class (``_target_``).
PLAIN_KEY = re.compile(r"seed|(?!hydra\b)[a-zA-Z]\w*(\.[a-zA-Z]\w*)+")
# An interpolation that may read the seed: it names the seed, or its own name is an interpolation.
MAY_READ_SEED = re.compile(r"\$\{[^}]*(seed|\$\{)")
# An interpolation that may read Hydra's node, which has the number and the words of a job.
READS_HYDRA = re.compile(r"\$\{\s*hydra\b")


def compose_jobs(
    loader: ConfigLoader, sweep: DictConfig, jobs: Sequence[Sequence[str]], first: int = 0
) -> list[Trial]:
    """Compose the trials of ``jobs``, each a list of words; ``sweep`` is the whole configuration.

    ``first`` is the number of the first job, for ``${hydra:job.num}``.
    """
    by_files: dict[tuple[str, ...], DictConfig] = {}
    by_settings: dict[tuple[str, ...], Trial] = {}
    trials = []
    hydra_words, allowed = typed_words(sweep.hydra.overrides)[0], tuple(sweep.allow_targets)
    for number, words in enumerate(jobs, first):
        overrides = (*hydra_words, *words)
        seeds = [int(match.group(1)) for word in words if (match := SEED.fullmatch(word))]
        without_seed = tuple(word for word in words if not SEED.fullmatch(word))
        if seeds and without_seed in by_settings:
            trials.append(
                replace(with_seed(by_settings[without_seed], seeds[-1]), overrides=overrides)
            )
            continue
        values = _plain_values(words)
        files = (*(word for word in words if word.partition("=")[0] not in values), *values)
        with explained(overrides):
            if files in by_files:
                composed = copy.deepcopy(by_files[files])
                for key, value in values.items():
                    OmegaConf.update(composed, key, value)
            else:
                command_words.check_search_path(words, allowed)
                composed = enforce_permissions(
                    loader.load_sweep_config(sweep, list(words)), allowed
                )
                with read_write(composed), open_dict(composed):
                    composed.hydra.job.num, composed.hydra.job.id = number, f"job_id_for_{number}"
                    HydraConfig.instance().set_config(composed)
                    composed.pop("hydra")  # large, and trials read it only by ${hydra:…}
            settings = repr(OmegaConf.to_container(composed, resolve=False))
            trials.append(resolve_trial(composed, overrides))
        reads_hydra = READS_HYDRA.search(settings)
        if not reads_hydra:
            by_files.setdefault(files, composed)
        if not reads_hydra and not MAY_READ_SEED.search(settings):
            by_settings[without_seed] = trials[-1]
    return trials


def resolve_times(sweep: DictConfig) -> None:
    """Resolve a sweep's settings once, so that ``${now:…}`` is the same for all its trials."""
    for key in [str(key) for key in sweep if key != "hydra"]:
        with suppress(OmegaConfBaseException):  # such as a setting that only the words of a job set
            if OmegaConf.is_config(sweep[key]):
                OmegaConf.to_container(sweep[key], resolve=True)


def typed_words(overrides: DictConfig) -> tuple[list[str], list[str]]:
    """The typed words in a node ``hydra.overrides``: those for Hydra, and those for gsbench."""
    words: Any = OmegaConf.to_container(overrides, resolve=False)
    return [word for word in words["hydra"] if word.partition("=")[0] not in ADDED], words["task"]


def with_seed(trial: Trial, seed: int) -> Trial:
    """The same trial with another seed.

    Only for a trial whose other settings do not read the seed.
    """
    seed = check_values(Config, {"seed": seed}, "")["seed"]
    words = tuple(f"seed={seed}" if word.startswith("seed=") else word for word in trial.overrides)
    return replace(trial, values=trial.values | {"seed": seed}, overrides=words)


def _plain_values(words: Sequence[str]) -> Mapping[str, Any]:
    """Numbers and texts that words give to settings; empty if the order of the words may matter."""
    values = [_key_and_value(word) for word in words]
    keys = [key.lstrip("+~") for key, _ in values if "." in key]
    parents = {key[:dot] for key in keys for dot in range(len(key)) if key[dot] == "."}
    if (
        len(set(keys)) < len(keys)
        or parents & set(keys)
        or any(isinstance(value, dict) for _, value in values)
    ):
        return {}
    plain = {
        key: value
        for key, value in values
        if PLAIN_KEY.fullmatch(key) and isinstance(value, int | float | str)
    }
    return {key: value for key, value in plain.items() if "$" not in str(value)}


@cache
def _key_and_value(word: str) -> tuple[str, Any]:
    """The key of a word, with the signs ``+`` and ``~``, and the value as Hydra reads it."""
    override = parse_word(word)
    return word.partition("=")[0], None if override.is_sweep_override() else override.value()


# ---- Hydra's entry points


@contextmanager
def hydra_ready() -> Iterator[None]:
    """Initialise Hydra with gsbench's configuration folder within the block."""
    register_schemas()
    if GlobalHydra.instance().is_initialized():  # within `hydra.main`, or in a block of this kind
        yield
        return
    try:
        with hydra.initialize_config_dir(str(conf_dir()), job_name="gsbench", **VERSION_BASE):
            yield
    finally:
        HydraConfig.instance().cfg = None


def config_loader() -> ConfigLoader:
    """Hydra's loader of configurations. Call it within `hydra_ready`."""
    return GlobalHydra.instance().config_loader()


def run_main(
    task: Callable[[Any], Any], argv: Sequence[str], config: DictConfig | None = None
) -> None:
    """Run ``task`` as an app of ``hydra.main`` with the words ``argv``; raises what it raises.

    Hydra may instantiate its own callbacks, the plug-ins that the checked ``config`` chooses, and
    the classes that it allows.
    """
    names = (
        []
        if config is None
        else [*config[PERMISSIONS], *(target for _, target in targets_in(plugins_of(config)))]
    )
    names = [name for name in names if all(part.isidentifier() for part in name.split("."))]
    register_schemas()
    saved_argv, sys.argv = sys.argv, ["gsbench", *argv]
    saved_full_error = os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # otherwise Hydra prints errors itself and exits
    whitelist = WHITELIST([*HYDRAS_CALLBACKS, *names, *(f"{name}.*" for name in names)])
    try:
        with whitelist, redirect_stderr(_WithoutHydrasLine(sys.stderr)):
            hydra.main(**VERSION_BASE, config_path=str(conf_dir()), config_name=CONFIG_NAME)(task)()
    finally:
        sys.argv = saved_argv
        os.environ.pop("HYDRA_FULL_ERROR")
        if saved_full_error is not None:
            os.environ["HYDRA_FULL_ERROR"] = saved_full_error
        HydraConfig.instance().cfg = None


def plugins_of(config: DictConfig) -> dict[str, Any]:
    """The nodes of a configuration from which Hydra makes the launcher and the sweeper."""
    return {
        key: OmegaConf.to_container(config.hydra[key], resolve=False)
        for key in ("launcher", "sweeper")
    }


class _WithoutHydrasLine:
    """Standard error without Hydra's line about a job's error, which gsbench prints itself."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        return len(text) if text.startswith(HYDRAS_LINE) else int(self._stream.write(text))


# ---- errors

MAX_MESSAGE = 400  # characters of a Hydra error that `explain` does not recognise
# for a choice that does not exist, by group: the word may name a user's class or a missing plug-in
HINTS = {
    **{
        group: f"; a class of your own is named by {group}._target_"
        for group in ("densify", "init", "raster")
    },
    "hydra/launcher": "; other launchers are separate packages; launch=serial, local or slurm "
    "need none",
    "hydra/sweeper": "; gsbench has its own; a search is an interval and hydra.sweeper.tune.points",
}

Errors = type[Exception] | tuple[type[Exception], ...]


@contextmanager
def explained(overrides: Sequence[str], errors: Errors = Exception) -> Iterator[None]:
    """Raise the block's ``errors`` as InputError: one line in terms of the words ``overrides``.

    By default these are all errors, since any error while Hydra composes comes from the user's
    input.
    """
    try:
        yield
    except GsbenchError:
        raise
    except errors as error:
        raise InputError(explain(error, overrides)) from error


def explain(error: BaseException, overrides: Sequence[str]) -> str:
    """Hydra's error in one line that names the key, what is allowed, and the nearest choice."""
    text = " ".join(_chain(error))
    override = re.search(r"Could not override '([^']+)'", text)
    unknown = re.search(r"Key '([^']+)' (?:is not in struct|not in '[^']+')", text)
    if unknown:
        return _unknown_setting(
            unknown.group(1), override.group(1) if override else None, text, overrides
        )
    group = re.search(
        r"Could not override '([\w/]+)'\.?\s*(?:Did you mean to override|No match in the defaults "
        r"list)",
        text,
    )
    if group:
        word = group.group(1)
        keys = [*GROUPS, *_keys_below("", overrides)]
        return (
            f"{word} is not a group or setting{did_you_mean(word, keys)} (groups: "
            f"{', '.join(GROUPS)})"
        )
    missing = re.search(
        r"Could not find '([^']+)'.*?Available options in '([^']+)':\s*(.*?)(?:\n\n|Config "
        r"search|$)",
        text,
        re.S,
    )
    if missing:
        wanted, name = missing.group(1), missing.group(2)
        choices = sorted({*options(name), *re.findall(r"[\w.-]+", missing.group(3))})
        word = wanted.rpartition("/")[2]
        near = did_you_mean(word, choices) or HINTS.get(name, "")
        return f"{name}={word} does not exist{near} (choose: {', '.join(choices)})"
    absent = re.search(r"[Mm]issing mandatory value: ([\w.]+)(?:\s+full_key: ([\w.]+))?", text)
    if absent:
        return f"{absent.group(2) or absent.group(1)} is not set: give it a value"
    folder = re.search(r"provider=.* path=(.*) is not available", text)
    if folder:
        return f"hydra.searchpath names {folder.group(1)}: no such folder"
    place = re.search(r"full_key: ([\w.\[\]]+)", text)
    text = re.sub(r"\s*(full_key|reference_type|object_type)[:=].*", "", text)
    return (f"{place.group(1)}: " if place else "") + " ".join(text.split())[:MAX_MESSAGE]


def _unknown_setting(bad: str, given: str | None, text: str, overrides: Sequence[str]) -> str:
    """The error for an unknown key ``bad``.

    ``given`` is the command line's whole key; None for a key in a file.
    """
    if given and given.startswith("hydra.sweeper.params."):
        return (
            f"{given}: params are for files of experiments; type "
            f"{given.partition('params.')[2]}=… itself, with -m"
        )
    if bad in ("grids", "tune"):
        what = "joins grids" if bad == "grids" else "tunes arms"
        return (
            f"hydra.sweeper.{bad}: gsbench's own sweeper alone {what}, so leave out hydra/sweeper"
        )
    key = given or bad
    parent = key[: key.rindex(bad)].rstrip(".") if bad in key else key.rpartition(".")[0]
    where = re.search(r"In '([^']+)'", text)
    file = ""
    # A YAML file's folder is the group. In an experiment's file, Hydra's full_key says where the
    # key stands.
    if where and not given:
        group, _, name = where.group(1).rpartition("/")
        full = re.search(r"full_key: ([\w.]+)", text)
        key = full.group(1) if full and full.group(1).endswith(bad) else f"{group}.{bad}"
        file, parent = f" in {group}/{name}.yaml", key.rpartition(".")[0]
    keys = _keys_below(parent, overrides)
    is_users_class = any(word.startswith(f"{parent}._target_=") for word in overrides)
    hint = (
        f"; a key that only your class has is added with a plus: +{key}=…" if is_users_class else ""
    )
    near = _belongs_to(parent, bad) or did_you_mean(bad, keys) or _groups_with(key)
    return (
        f"{key} is not a setting{file}{near}{hint} ({parent or 'top level'} has: "
        f"{', '.join(keys) or 'no settings'})"
    )


def _groups_with(key: str) -> str:
    """``; did you mean scene.path?`` for a key that lacks its group; else nothing."""
    groups = [group for group in GROUPS if group != "experiment"] if "." not in key else []
    places = [f"{group}.{key}" for group in groups if key in _keys_below(group, [])]
    return f"; did you mean {' or '.join(places)}?" if places else ""


def _belongs_to(group: str, key: str) -> str:
    """``; it belongs to densify=volumetric`` if other choices have the setting, else ""."""
    if group not in GROUPS:
        return ""
    key_line = re.compile(rf"^{re.escape(key)}:", re.M)
    files = {
        name: Path(conf_dir(), group, f"{name}.yaml") for name in options(group) if "/" not in name
    }
    choices = [
        name for name, file in files.items() if key_line.search(file.read_text(encoding="utf-8"))
    ]
    return f"; it belongs to {group}={' or '.join(choices[:3])}" if choices else ""


def _chain(error: BaseException | None) -> list[str]:
    """The messages of an error and of its causes."""
    messages = []
    while error is not None:
        messages.append(str(error))
        error = error.__cause__
    return messages


def _keys_below(parent: str, overrides: Sequence[str]) -> list[str]:
    """The settings below ``parent``, with the group choices of ``overrides`` if they compose."""
    groups = (*GROUPS, "hydra/launcher", "hydra/sweeper")
    choices = [
        word
        for word in overrides
        if re.fullmatch(r"[\w/]+=[\w/-]+", word) and word.split("=")[0] in groups
    ]
    with hydra_ready():
        try:
            config = hydra.compose(CONFIG_NAME, choices, return_hydra_config=True)
        except Exception:  # noqa: BLE001 - a choice itself may be wrong
            config = hydra.compose(CONFIG_NAME, [], return_hydra_config=True)
    node = OmegaConf.select(config, parent) if parent else config
    # Hydra's plug-ins are chosen by name, not by class
    hidden = "_target_" if parent.startswith("hydra") else "hydra"
    return [str(key) for key in node if key != hidden] if isinstance(node, DictConfig) else []
