"""Permissions of a configuration: it may run gsbench's own classes, and what the command line allows.

Permission is what the command line says of ``allow_targets``; no file can give it. It names modules (``mine``),
programs (``bash``) and environment variables (``PATH``). `docs/security.md` says what this protects from.

`check_composed` looks at what a command line composes, Hydra's own settings included, before Hydra makes any object of
it; `check_permissions` at the resolved values of each trial, before its parts are made. Loads no Hydra by itself.
"""

import importlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import GrammarParseError
from omegaconf.grammar_parser import parse

from gsbench.errors import InputError
from gsbench.external.settings import program_of
from gsbench.system.own_modules import allowed_modules
from gsbench.words import closest

TARGET = "_target_"
PERMISSIONS = "allow_targets"  # the setting that says what may run; it counts on the command line only
PACKAGE = "gsbench"
COMPONENTS = ("init", "densify", "raster")  # groups that name one class each; `eval.extra` names any number
EXTERNAL = ("gsbench.densify.External", "gsbench.external.settings.External")  # names of the class: another program
SHELL, SBATCH = "bash", "sbatch"  # the permissions for lines of a shell, and for unusual options of Slurm
# Variables that a configuration may set: they choose numbers of threads and devices. No list of the dangerous ones
# could be complete: MPLBACKEND imports a module, NUMBA_CACHE_DIR unpickles, CUDA_INJECTION64_PATH and GCONV_PATH load
# libraries, CC names a program.
FREE_VARIABLES = frozenset(
    """
    OMP_NUM_THREADS OMP_THREAD_LIMIT OMP_DYNAMIC OMP_PROC_BIND OMP_PLACES OMP_SCHEDULE OMP_STACKSIZE OMP_WAIT_POLICY
    MKL_NUM_THREADS OPENBLAS_NUM_THREADS NUMEXPR_NUM_THREADS NUMBA_NUM_THREADS VECLIB_MAXIMUM_THREADS
    CUDA_VISIBLE_DEVICES CUDA_DEVICE_ORDER CUDA_LAUNCH_BLOCKING CUBLAS_WORKSPACE_CONFIG PYTORCH_CUDA_ALLOC_CONF
    HIP_VISIBLE_DEVICES ROCR_VISIBLE_DEVICES TZ
    """.split()  # noqa: SIM905 - words are easier to read than a list of 20 quoted ones
)
# Options of sbatch that choose resources, of Slurm's manual. Others can run a program (task_prolog), a container, or
# hand variables on (export).
SBATCH_RESOURCES = frozenset(
    """
    account begin clusters comment constraint contiguous core_spec cores_per_socket cpu_freq cpus_per_gpu cpus_per_task
    deadline dependency exclude exclusive gpu_bind gpu_freq gpus gpus_per_node gpus_per_socket gpus_per_task gres
    gres_flags hint hold licenses mail_type mail_user mem mem_bind mem_per_cpu mem_per_gpu mincpus network nice nodelist
    nodes ntasks ntasks_per_core ntasks_per_gpu ntasks_per_node ntasks_per_socket overcommit oversubscribe partition
    prefer priority qos requeue reservation signal sockets_per_node spread_job switches thread_spec threads_per_core
    time time_min tmp use_min_nodes wckey
    """.split()  # noqa: SIM905
)
BARE = re.compile(r"[\w./+-]+")  # what needs no quotes in a list on the command line

# ---- of Hydra's own settings
SPECIAL_KEYS = (  # what Hydra reads beside _target_
    "_recursive_", "_convert_", "_args_", "_partial_", "_isolate_", "_execution_whitelist_"
)  # fmt: skip
OWN_SWEEPER = "hydra_plugins.gsbench.GsbenchSweeper"
# Launchers that are looked for among the installed plug-ins. Others can run a line in a shell, as submitit's can.
LAUNCHERS = ("GsbenchLauncher", "BasicLauncher", "JoblibLauncher")
HYDRAS_CALLBACKS = tuple(
    f"hydra.experimental.callbacks.{name}" for name in ("LogJobReturnCallback", "PickleJobInfoCallback")
)
# Settings of Hydra's that stay as conf/config.yaml has them, and why. Some start code: sweepers and logging name
# classes, and a variable can name what Python, a library or a program loads.
RUNS_TRIALS = "gsbench runs the trials itself, as launch=serial, local or slurm says: leave it out"
IN_LOG = "log.txt in a trial's folder holds everything: leave it out"
NO_LOGGING = {"version": 1, "root": None, "disable_existing_loggers": False}
FIXED: dict[str, tuple[Any, str]] = {
    "output_subdir": (None, RUNS_TRIALS),
    "run": ({"dir": "."}, RUNS_TRIALS),
    "sweep": ({"dir": "${runs}/.hydra", "subdir": "."}, RUNS_TRIALS),
    "job.chdir": (False, "trials run in the folder where the command was given, and paths start there: leave it out"),
    "job.env_set": ({}, "set variables in the shell, before the command"),
    "verbose": (False, IN_LOG),
    "job_logging": (NO_LOGGING, IN_LOG),
    "hydra_logging": (NO_LOGGING, IN_LOG),
}
# Resolvers that make texts and numbers. Those that make mappings of texts (oc.create, oc.decode, oc.dict) could make a
# class's name after it was looked for; others, of plug-ins, could do anything.
RESOLVERS = ("hydra", "now", "oc.env", "oc.select", "python_version")
# Values of Hydra 1.4's own, whose resolvers join the words of a job; with arguments they would call other resolvers.
HYDRAS_VALUES = ("${hydra_override_dirname:}", "${hydra_deprecated_override_dirname:}")
PUBLIC_CLASS = re.compile(rf"{PACKAGE}\.\w+\.[A-Z]\w*")  # known by its name; importing it may take seconds
# Settings that a file's sweep may not give its jobs: the look at the whole comes before these are composed.
NOT_SWEPT = re.compile(rf"[\s+~]*(hydra|{PERMISSIONS})\s*([./@:=\[]|$)")


def is_allowed(target: str, allowed: Sequence[str]) -> bool:
    """Return whether ``target``, the import path of a class, is one of ``allowed`` or lies below it."""
    return any(target == prefix or target.startswith(prefix.rstrip(".") + ".") for prefix in allowed)


def to_type(missing: Sequence[str], allowed: Sequence[str]) -> str:
    """The word to be typed so that ``missing`` is allowed beside what is: ``allow_targets=[mine,bash]``."""
    names = [name if BARE.fullmatch(name) else repr(name) for name in dict.fromkeys([*allowed, *missing])]
    return f"add allow_targets=[{','.join(names)}] to the command; no file can allow it"


def check_target(target: str | None, group: str, allowed: Sequence[str], own: Sequence[str] = (PACKAGE,)) -> None:
    """Refuse a ``_target_`` outside ``own`` and what the user ``allowed``: importing it would run its code."""
    if not target:
        raise InputError(f"{group} names no _target_: the class to use")
    if is_allowed(target, (*own, *allowed)) and target != PACKAGE:
        return
    prefix = target.split(".")[0]
    if prefix == PACKAGE:
        raise InputError(f"{group}.{TARGET}={target} is not a class for {group}")
    near = closest(prefix, allowed)
    advice = to_type([prefix], allowed)
    raise InputError(f"{group}.{TARGET}={target} is not gsbench's own{near}; if you trust that code, {advice}")


def load_class(target: str, group: str, allowed: Sequence[str]) -> Any:
    """Load the class at the import path ``target``; it must be of gsbench or of a module that the user ``allowed``.

    A name that a trusted module merely imported (``mine.Popen``) is somebody else's code. Raises InputError.
    """
    check_target(target, group, allowed)
    module, _, name = target.rpartition(".")
    missing = object()
    try:
        place = importlib.import_module(module)
        found = getattr(place, name, missing)
    except (Exception, SystemExit) as error:  # importing a user's file runs it: it may raise anything
        reason = f"{type(error).__name__}: {error}{_beside(error)}"
        raise InputError(f"{group}.{TARGET}={target} cannot be imported ({reason})") from error
    if found is missing:
        raise InputError(
            f"{group}.{TARGET}={target} cannot be imported: {module} has no {name}{closest(name, dir(place))}"
        )
    home = f"{getattr(found, '__module__', None)}.{getattr(found, '__qualname__', name)}"
    if isinstance(found, type) and not is_allowed(home, (PACKAGE, *allowed)):
        advice = to_type([home.split(".")[0]], allowed)
        raise InputError(f"{group}.{TARGET}={target} is {home}; if you trust that code, {advice}")
    return found


def _beside(error: BaseException) -> str:
    """The mend where a module is missing that lies in another folder, or beside an allowed one without being so."""
    if not isinstance(error, ModuleNotFoundError):
        return ""
    name, known = (error.name or "").split(".")[0], allowed_modules()
    if name in known:
        return f"; your modules are looked for where the command is given: {known[name]}"
    if name and any(Path(place, f"{name}.py").is_file() or Path(place, name).is_dir() for place in known.values()):
        return f"; it lies here, but only what allow_targets names is imported from here: add {name} there"
    return ""


def check_permissions(values: Mapping[str, Any]) -> None:
    """Refuse the resolved configuration of a trial that would make run what its ``allow_targets`` does not name.

    This is the last check, of plain values, whatever file or command line they came from. Raises InputError.
    """
    allowed = values.get(PERMISSIONS) or []
    # A class that nobody allowed may stand anywhere, also within the options of one that is: its owner may build it.
    for place, target in targets_in(values):
        group = ".".join(place)
        check_target(target, group, allowed, homes_of(place))
    if is_external(values["densify"]):
        check_program(values["densify"], allowed)
    _check_launch(values["launch"], allowed)


def targets_in(values: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every ``_target_`` at any depth, lists included, with the keys that lead to the mapping that has it."""
    if isinstance(values, Mapping):
        if values.get(TARGET) is not None:
            yield place, values[TARGET]
        for key, value in values.items():
            yield from targets_in(value, (*place, str(key)))
    elif isinstance(values, list | tuple):
        for number, value in enumerate(values):
            yield from targets_in(value, (*place, str(number)))


def homes_of(place: Sequence[str]) -> tuple[str, ...]:
    """The packages of gsbench whose classes may stand at a place of the configuration without the user's permission."""
    if len(place) == 1 and place[0] in COMPONENTS:
        own = f"{PACKAGE}.{place[0]}"
        return (own, f"{PACKAGE}.external") if place[0] == "densify" else (own,)
    if len(place) == 3 and tuple(place[:2]) == ("eval", "extra"):
        return (f"{PACKAGE}.eval",)
    return ()


def check_composed(config: DictConfig, allowed: Sequence[str]) -> None:
    """Refuse a composed configuration, with Hydra's node, that would make run what was not ``allowed``.

    What is looked at is what stands there, before ``${…}`` is resolved: where that could change what is run, it is
    refused. Raises InputError.
    """
    raw: Any = OmegaConf.to_container(config, resolve=False)
    if "hydra" in raw:  # else Hydra has taken it already: it runs the job
        _check_hydra(raw["hydra"])
    for place, key, value in _entries(raw):
        if isinstance(value, str) and "${" in value:
            _check_interpolation(place, key, value)
        if key in SPECIAL_KEYS:  # `_partial_` makes a function of anything, to be called later
            raise InputError(f"{'.'.join((*place, key))}: gsbench makes no objects this way: leave it out")
    for place, target in targets_in(raw):
        _check_place(place, target, allowed)


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
    if key.startswith("_") and key.endswith("_"):  # the name that is looked at would not be the one that is imported
        raise InputError(f"{where}={value}: write the name itself here, since ${{…}} may become another")
    try:
        resolvers = list(_resolvers(parse(value)))
    except GrammarParseError:  # nothing can be made of it; Hydra says so where somebody asks for the value
        return
    for name in resolvers:
        if name == "hydra" and place[:1] != ("hydra",):
            raise InputError(f"{where}={value}: a trial gets its settings from gsbench, so they cannot read Hydra's")
        if name not in RESOLVERS:
            raise InputError(f"{where}={value}: ${{{name}:…}} is not resolved here, only {', '.join(RESOLVERS)}")


def _resolvers(tree: Any) -> Iterator[str]:
    """The names of the resolvers in a parsed text; one that is itself an interpolation as it is written."""
    if type(tree).__name__ == "ResolverNameContext":
        yield tree.getText()
    for child in getattr(tree, "children", None) or []:
        yield from _resolvers(child)


def _check_place(place: tuple[str, ...], target: Any, allowed: Sequence[str]) -> None:
    """Refuse a class at a ``place``: Hydra imports what a name leads to, and calls it."""
    if not isinstance(target, str) or target == "???" or place in (("hydra", "launcher"), ("hydra", "sweeper")):
        return  # a schema, Hydra or `_check_hydra` says what is wrong with it
    group = ".".join(place)
    # Of gsbench's own classes each is for its group: `densify._target_=gsbench.init.…` would run another's constructor.
    own = HYDRAS_CALLBACKS if place[:2] == ("hydra", "callbacks") and len(place) == 3 else homes_of(place)
    check_target(target, group, allowed, own)
    if is_allowed(target, (PACKAGE,)) and not PUBLIC_CLASS.fullmatch(target):
        load_class(target, group, allowed)  # such as gsbench.densify.adc.torch.load


def _check_hydra(hydra: dict[str, Any]) -> None:
    """Refuse of Hydra's own settings what is not read here, and what would start code."""
    for name, (fixed, why) in FIXED.items():
        group, _, key = name.partition(".")
        found = hydra.get(group) if not key else hydra[group].get(key)
        if isinstance(fixed, dict) and (isinstance(found, dict) or found is None):
            found = {**fixed, **(found or {})}
        if found != fixed:
            raise InputError(f"hydra.{name}: {why}")
    launcher, sweeper = hydra["launcher"], hydra["sweeper"]
    if sweeper.get(TARGET) != OWN_SWEEPER:
        raise InputError("hydra.sweeper: gsbench has its own, which searches intervals, too: leave hydra/sweeper out")
    # ${…} may stand for a mapping with a class in it, of which Hydra would make an object when it makes these.
    made = {"callbacks": hydra["callbacks"], "launcher": launcher, "sweeper": sweeper | {"params": None, "grids": None}}
    for place, key, value in _entries(made, ("hydra",)):
        if isinstance(value, str) and "${" in value:
            raise InputError(f"{'.'.join((*place, key))}: write the settings themselves here, without ${{…}}")
    if not isinstance(launcher, dict) or launcher.get(TARGET) not in known_launchers():
        raise InputError("hydra.launcher: gsbench works with basic and joblib, beside launch=serial, local and slurm")
    # A job is composed after this look: its words may search packages.
    for place, key, value in _entries(sweeper, ("hydra", "sweeper")):
        for text in (key, value) if key != TARGET else ():
            if isinstance(text, str) and NOT_SWEPT.match(text):
                raise InputError(
                    f"{'.'.join(place)}: {text} cannot differ from job to job, and no file can allow it: "
                    "type it on the command line"
                )


def known_launchers() -> set[str]:
    """The import paths of `LAUNCHERS`, as far as they are installed."""
    from hydra.core.plugins import Plugins
    from hydra.plugins.launcher import Launcher

    every = Plugins.instance().discover(Launcher)
    return {f"{found.__module__}.{found.__name__}" for found in every if found.__name__ in LAUNCHERS}


def load_callbacks(callbacks: Any, allowed: Sequence[str]) -> None:
    """Import the classes that ``hydra.callbacks`` names, of which Hydra will make objects; refuse what is none."""
    from hydra.experimental.callback import Callback

    for name, callback in (callbacks or {}).items():
        if not isinstance(callback, Mapping) or not callback.get(TARGET):
            raise InputError(f"hydra.callbacks.{name} names no {TARGET}: the class to use")
        for place, target in targets_in(callback, ("hydra", "callbacks", str(name))):
            found = load_class(target, ".".join(place), [*allowed, *HYDRAS_CALLBACKS])
            if not isinstance(found, type) or (len(place) == 3 and not issubclass(found, Callback)):
                wanted = "a class of hydra.experimental.callback.Callback" if len(place) == 3 else "a class"
                raise InputError(f"{'.'.join(place)}.{TARGET}={target} is not {wanted}")


def is_external(densify: Mapping[str, Any]) -> bool:
    """Return whether these settings are another program's; by a path other than `EXTERNAL` nothing builds the class."""
    return densify.get(TARGET) in EXTERNAL


def check_program(settings: Mapping[str, Any], allowed: Sequence[str]) -> None:
    """Refuse another trainer whose programs or variables the user did not allow."""
    # A YAML of somebody's may call any program of this machine a trainer, or load code into one by a variable.
    options = settings.get("options") or {}
    programs = [program_of(settings.get("command") or "", options)]
    if settings.get("version_command") is not None:
        programs.append(program_of(settings["version_command"], options, "densify.version_command"))
    programs = [program for program in dict.fromkeys(programs) if program not in allowed]
    variables = foreign_variables(settings.get("environment") or {}, allowed)
    if not programs and not variables:
        return
    runs = [f"runs the program {' and '.join(map(repr, programs))}"] * bool(programs)
    sets = [f"sets {shown(variables)}"] * bool(variables)
    raise InputError(
        f"densify={settings['name']} {' and '.join(runs + sets)}; if you trust it, "
        + to_type([*programs, *variables], allowed)
    )


def foreign_variables(variables: Mapping[str, Any], allowed: Sequence[str]) -> dict[str, Any]:
    """List the ``variables`` that a configuration may not set: neither free, nor allowed, nor as they are already."""
    return {
        name: value
        for name, value in variables.items()
        if name not in FREE_VARIABLES and name not in allowed and value != os.environ.get(name)
    }


def shown(variables: Mapping[str, Any]) -> str:
    """Variables with their values, for a message."""
    return ", ".join(f"{name}={value!r}" for name, value in variables.items())


def _check_launch(launch: Mapping[str, Any], allowed: Sequence[str]) -> None:
    """Refuse lines for a shell, and what could become one in the script that Slurm runs."""
    if launch.get("setup") and SHELL not in allowed:
        raise InputError(
            f"launch.setup runs {'; '.join(map(str, launch['setup']))!r} in a shell; if you trust it, "
            + to_type([SHELL], allowed)
        )
    options = {str(name).replace("-", "_"): value for name, value in (launch.get("sbatch") or {}).items()}
    if (others := sorted(options.keys() - SBATCH_RESOURCES)) and SBATCH not in allowed:
        raise InputError(
            f"launch.sbatch.{others[0]} chooses more than resources; if you trust it, " + to_type([SBATCH], allowed)
        )
    texts = {f"launch.{name}": launch.get(name) for name in ("partition", "account", "qos")}
    texts |= {f"launch.sbatch.{name}": value for name, value in options.items()}
    for key, value in texts.items():  # a line break would end the comment that Slurm reads, and begin a command
        if not str(value).isprintable() or not key.isprintable():
            raise InputError(f"{key} must be one line, got {value!r}")
