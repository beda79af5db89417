"""Hydra's loader of configurations, behind a guard: nothing that it composes can make anything run unasked.

Every configuration that gsbench composes comes through it: that of the command line, and that of each job of a sweep,
in this process or in that of another launcher. It refuses what Hydra would run while it composes, looks at the whole
before anybody makes objects of it, Hydra's own node included, and says in ``allow_targets`` what was typed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigNode, ConfigStore
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.experimental.callback import Callback
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import GrammarParseError, OmegaConfBaseException
from omegaconf.grammar_parser import parse

from gsbench.config.command_words import parse_word
from gsbench.config.hydra_internals import WHITELIST, Callbacks, ConfigLoaderImpl
from gsbench.config.trust import (
    PACKAGE,
    PERMISSIONS,
    SHELL,
    TARGET,
    check_target,
    foreign_variables,
    homes_of,
    is_allowed,
    load_class,
    shown,
    targets_in,
    to_type,
)
from gsbench.errors import InputError
from gsbench.system.own_modules import allow_modules

if TYPE_CHECKING:
    from hydra._internal.defaults_list import DefaultsList

OF_CALLBACKS = ("_recursive_", "_convert_", "_args_")
SPECIAL_KEYS = (*OF_CALLBACKS, "_partial_", "_isolate_", "_execution_whitelist_")  # what Hydra reads beside _target_
HYDRAS_CALLBACKS = tuple(
    f"hydra.experimental.callbacks.{name}" for name in ("LogJobReturnCallback", "PickleJobInfoCallback")
)
PLUGINS = {("hydra", "launcher"): Launcher, ("hydra", "sweeper"): Sweeper}
MADE_BY_HYDRA = ("callbacks", "launcher", "sweeper")  # nodes below `hydra` of which Hydra makes objects
# Resolvers that make texts and numbers. Those that make mappings of texts (oc.create, oc.decode, oc.dict) could make a
# class's name after it was looked for; others, of plug-ins, could do anything.
RESOLVERS = ("hydra", "now", "oc.env", "oc.select", "python_version")
# Values of Hydra 1.4's own, whose resolvers join the words of a job; with arguments they would call other resolvers.
HYDRAS_VALUES = ("${hydra_override_dirname:}", "${hydra_deprecated_override_dirname:}")
PUBLIC_CLASS = re.compile(rf"{PACKAGE}\.\w+\.[A-Z]\w*")  # known by its name; importing it may take seconds
NO_LOGGING = {"version": 1, "root": None, "disable_existing_loggers": False}
SHELL_SETTINGS = ("setup", "python", "srun_args", "additional_parameters")  # of submitit's launchers: lines and options


def typed_permissions(words: Sequence[str]) -> tuple[str, ...]:
    """The names that a command line allows: those of ``allow_targets=[…]``, the last if it stands there twice."""
    found: tuple[str, ...] = ()
    for word in words:
        override = parse_word(word)
        if override.get_key_element().lstrip("+~") != PERMISSIONS or override.is_sweep_override():
            continue
        names: Any = override.value()
        if not isinstance(names, list) or not all(isinstance(name, str) and name and "$" not in name for name in names):
            raise InputError(f"{word}: {PERMISSIONS} is a list of names, such as {PERMISSIONS}=[mine]")
        found = tuple(names)
    return found


class GuardedLoader(ConfigLoaderImpl):
    """Hydra's loader for one command line, whose user allowed ``allowed``; ``folder`` is where the user's modules lie.

    In another process, to which a launcher brought it, the user's modules are found from then on.
    """

    def __init__(self, path: ConfigSearchPath, allowed: Sequence[str], folder: str) -> None:
        super().__init__(path)
        self.allowed, self.folder = tuple(allowed), folder

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        allow_modules(self.allowed, self.folder)

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
        """Compose a job of a sweep. Hydra 1.3 does so by `load_configuration`, 1.4 does not."""
        check_search_path(sweep_overrides, self.allowed)
        return self._guarded(super().load_sweep_config(master_config, sweep_overrides))

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        check_search_path(overrides, self.allowed)
        return self._guarded(
            super().load_configuration(config_name, overrides, run_mode, from_shell, validate_sweep_overrides)
        )

    def _guarded(self, config: DictConfig) -> DictConfig:
        check_composed(config, self.allowed)
        with read_write(config), open_dict(config):
            config[PERMISSIONS] = list(self.allowed)
        return config

    def get_group_options(
        self,
        group_name: str,
        results_filter: ObjectType | None = ObjectType.CONFIG,
        config_name: str | None = None,
        overrides: list[str] | None = None,
    ) -> list[str]:
        check_search_path(overrides or [], self.allowed)
        return super().get_group_options(group_name, results_filter, config_name, overrides)

    def compute_defaults_list(self, config_name: str | None, overrides: list[str], run_mode: RunMode) -> DefaultsList:
        check_search_path(overrides, self.allowed)
        return super().compute_defaults_list(config_name, overrides, run_mode)


def check_search_path(words: Sequence[str], allowed: Sequence[str]) -> None:
    """Refuse a place of configurations that Hydra would import: ``hydra.searchpath=[pkg://package]``.

    Hydra 1.4 takes ``hydra[searchpath]`` and ``extend_list(pkg://package)`` as well.
    """
    for word in words:
        override = parse_word(word)
        key = override.get_key_element().lstrip("+~").replace("[", ".").replace("]", "")
        if key != "hydra.searchpath" or override.is_sweep_override():
            continue
        value: Any = override.value()
        for place in value if isinstance(value, list) else getattr(value, "values", ()):
            scheme, colon, path = str(place).partition("://")
            if not colon or scheme == "file":
                continue
            package = path.replace("/", ".")
            if scheme != "pkg":
                raise InputError(f"hydra.searchpath: {place} is neither a folder (file://…) nor a package (pkg://…)")
            if not is_allowed(package, (PACKAGE, *allowed)):
                advice = to_type([package.split(".")[0]], allowed)
                raise InputError(f"hydra.searchpath: {place} imports a package; if you trust it, {advice}")


def check_composed(config: DictConfig, allowed: Sequence[str]) -> None:
    """Refuse a composed configuration, with Hydra's node, that would make run what was not ``allowed``.

    What is looked at is what stands there, before ``${…}`` is resolved: where that could change what is run, it is
    refused. Raises InputError.
    """
    raw: Any = OmegaConf.to_container(config, resolve=False)
    for place, key, value in _entries(raw):
        if isinstance(value, str) and "${" in value:
            _check_interpolation(place, key, value)
        if key in SPECIAL_KEYS and (key not in OF_CALLBACKS or place[:2] != ("hydra", "callbacks")):
            raise InputError(f"{'.'.join((*place, key))}: gsbench makes no objects so: leave it out")
    for place, target in targets_in(raw):
        _check_place(place, target, allowed)
    if isinstance(raw, dict) and "hydra" in raw:
        _check_hydra(raw["hydra"], allowed)
        _check_copies(config, raw["hydra"])


def load_callbacks(config: DictConfig) -> None:
    """Import the classes that ``hydra.callbacks`` names, of which Hydra will make objects; refuse what is none."""
    allowed = list(config[PERMISSIONS])
    callbacks = OmegaConf.to_container(config.hydra.callbacks or OmegaConf.create(), resolve=False)
    assert isinstance(callbacks, dict)
    for name, callback in callbacks.items():
        if not isinstance(callback, dict) or not callback.get(TARGET):
            raise InputError(f"hydra.callbacks.{name!s} names no {TARGET}: the class to use")
    for place, target in targets_in(callbacks, ("hydra", "callbacks")):
        group, is_callback = ".".join(place), len(place) == 3
        found = load_class(target, group, [*allowed, *HYDRAS_CALLBACKS] if is_callback else allowed)
        if not isinstance(found, type) or (is_callback and not issubclass(found, Callback)):
            wanted = "a class of hydra.experimental.callback.Callback" if is_callback else "a class"
            raise InputError(f"{group}.{TARGET}={target} is not {wanted}")


def make_callbacks(config: DictConfig) -> Callbacks:
    """Make the objects of ``hydra.callbacks``; Hydra itself refuses classes of others, from its version 1.4 on."""
    allowed = [name for name in config[PERMISSIONS] if all(part.isidentifier() for part in name.split("."))]
    with WHITELIST([*HYDRAS_CALLBACKS, *allowed, *(f"{name}.*" for name in allowed)]):
        return Callbacks(config)


def _entries(values: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str, Any]]:
    """Every key and value at any depth, lists included, with the keys that lead there."""
    if isinstance(values, dict | list):
        for key, value in values.items() if isinstance(values, dict) else enumerate(values):
            yield place, str(key), value
            yield from _entries(value, (*place, str(key)))


def _check_interpolation(place: tuple[str, ...], key: str, value: str) -> None:
    where = ".".join((*place, key))
    if place == ("hydra", "job") and value in HYDRAS_VALUES:
        return
    if key.startswith("_") and key.endswith("_"):
        raise InputError(f"{where}={value}: write the name itself here, since ${{…}} may become another")
    try:
        resolvers = list(_resolvers(parse(value)))
    except GrammarParseError:  # nothing can be made of it; Hydra says so where somebody asks for the value
        return
    for name in resolvers:
        if name not in RESOLVERS:
            raise InputError(f"{where}={value}: ${{{name}:…}} is not resolved here, only {', '.join(RESOLVERS)}")


def _resolvers(tree: Any) -> Iterator[str]:
    """The names of the resolvers in a parsed text; one that is itself an interpolation as it is written."""
    if type(tree).__name__ == "ResolverNameContext":
        yield tree.getText()
    for child in getattr(tree, "children", None) or []:
        yield from _resolvers(child)


def _check_place(place: tuple[str, ...], target: Any, allowed: Sequence[str]) -> None:
    group = ".".join(place)
    if not isinstance(target, str) or target == "???":
        return  # a schema or Hydra says what is wrong with it, and nothing can be made of it
    if place in PLUGINS:
        known = {f"{found.__module__}.{found.__name__}" for found in Plugins.instance().discover(PLUGINS[place])}
        if target not in known:
            raise InputError(f"{group}.{TARGET}={target} is no {place[-1]} that is installed")
        return
    own = HYDRAS_CALLBACKS if place[:2] == ("hydra", "callbacks") and len(place) == 3 else homes_of(place)
    check_target(target, group, allowed, own)
    if is_allowed(target, (PACKAGE,)) and not PUBLIC_CLASS.fullmatch(target):
        load_class(target, group, allowed)  # such as gsbench.densify.adc.torch.load


def _check_hydra(hydra: Any, allowed: Sequence[str]) -> None:
    """Refuse of Hydra's own settings what starts code other than by naming a class."""
    for name in ("job", "job.env_set", "job_logging", "hydra_logging", *MADE_BY_HYDRA):
        node = hydra
        for key in name.split("."):
            node = node.get(key) if isinstance(node, dict) else node
        if isinstance(node, str):
            raise InputError(f"hydra.{name}={node}: write the settings themselves here, as ${{…}} may become others")
    for group in ("job_logging", "hydra_logging"):
        if {**NO_LOGGING, **(hydra.get(group) or {})} != NO_LOGGING:
            raise InputError(f"gsbench does not read hydra/{group}: log.txt in a trial's folder holds everything")
    if variables := foreign_variables(hydra["job"].get("env_set") or {}, allowed):
        raise InputError(
            f"hydra.job.env_set sets {shown(variables)}; set it in the shell, before the command, or if you trust it, "
            + to_type(list(variables), allowed)
        )
    launcher = hydra.get("launcher") or {}
    for place, key, value in _entries(launcher, ("hydra", "launcher")):
        if isinstance(value, str) and not value.isprintable():
            raise InputError(f"{'.'.join((*place, key))} must be one line, got {value!r}")
    _check_launcher(launcher, allowed)


def _check_launcher(launcher: dict[str, Any], allowed: Sequence[str]) -> None:
    """Refuse of a launcher's settings those that reach a shell, and those that its plug-in does not know.

    submitit's hand the latter on to Slurm's script under their names, lines for a shell among them (``teardown``).
    """
    known = _settings_of_launcher(launcher.get(TARGET))
    for key, value in launcher.items():
        if SHELL in allowed or not value or key == TARGET:
            continue
        if key in SHELL_SETTINGS:
            why = "runs in a shell"
        elif key not in known:
            why = "is no setting that this launcher lists, and may run in a shell"
        else:
            continue
        raise InputError(f"hydra.launcher.{key}={value!r} {why}; if you trust it, {to_type([SHELL], allowed)}")


def _settings_of_launcher(target: Any) -> set[str]:
    """Return the names of all settings that installed plug-ins have registered for the launcher ``target``."""
    group = ConfigStore.instance().repo.get("hydra", {}).get("launcher", {})
    nodes = [entry.node for entry in group.values() if isinstance(entry, ConfigNode)]
    return {str(key) for node in nodes if node.get(TARGET) == target for key in node}


def _check_copies(config: DictConfig, hydra: dict[str, Any]) -> None:
    """Refuse ``${…}`` that stands for a whole mapping where Hydra makes objects: its classes are for other places."""
    for node in MADE_BY_HYDRA:
        for place, key, value in _entries(hydra.get(node), ("hydra", node)):
            if isinstance(value, str) and value.startswith("${") and place[2:3] not in (("params",), ("grids",)):
                where = ".".join((*place, key))
                try:
                    copied = OmegaConf.is_config(OmegaConf.select(config, where))
                except OmegaConfBaseException:  # such as ${hydra:job.num}, which no mapping will stand for
                    continue
                if copied:
                    raise InputError(f"{where}={value}: write the settings themselves here, since ${{…}} copies others")
