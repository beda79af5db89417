"""Permissions: a configuration may run gsbench's own classes, and what the command line allows.

Only the command line gives permission; no file can. ``allow_targets`` names modules (``mine``),
programs (``bash``), environment variables (``PATH``) and addresses; a typed address or place to
write is allowed, too. `docs/security.md` says what this protects from.

`check_composed` checks a composed configuration, Hydra's own settings included, before Hydra makes
any object of it. `check_permissions` checks the resolved values of each trial before its parts are
made. Loads no Hydra by itself.
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
from gsbench.runs.nested import TARGET, entries_of, targets_in
from gsbench.settings import foreign_address
from gsbench.system.own_modules import allowed_modules
from gsbench.words import did_you_mean

# the setting that says what may run; it counts on the command line only
PERMISSIONS = "allow_targets"
PACKAGE = "gsbench"
# groups that name one class each; `eval.extra` names any number
COMPONENTS = ("init", "densify", "raster", "tracking")
# import paths of one class
EXTERNAL = ("gsbench.densify.External", "gsbench.external.settings.External")
# the permissions for shell lines, and for unusual options of Slurm
SHELL, SBATCH = "bash", "sbatch"
# Where gsbench and Hydra write, by gsbench's own configuration (None: what the installed packages
# say). Only the command line chooses another place: Hydra would overwrite a ``config.yaml`` there.
WRITTEN = {
    "runs": "${oc.env:GSBENCH_RUNS,runs}",
    "hydra.run.dir": None,
    "hydra.sweep.dir": None,
    "hydra.sweep.subdir": None,
    "hydra.output_subdir": None,
    "hydra.job.name": None,
}
# Variables that a configuration may set: they choose numbers of threads and devices. This is a list
# of harmless ones, since no list of dangerous ones could be complete: MPLBACKEND imports a module,
# NUMBA_CACHE_DIR unpickles, CUDA_INJECTION64_PATH and GCONV_PATH load libraries, CC names a
# program.
FREE_VARIABLES = frozenset(
    """
    OMP_NUM_THREADS OMP_THREAD_LIMIT OMP_DYNAMIC OMP_PROC_BIND OMP_PLACES OMP_SCHEDULE OMP_STACKSIZE
    OMP_WAIT_POLICY MKL_NUM_THREADS OPENBLAS_NUM_THREADS NUMEXPR_NUM_THREADS NUMBA_NUM_THREADS
    VECLIB_MAXIMUM_THREADS CUDA_VISIBLE_DEVICES CUDA_DEVICE_ORDER CUDA_LAUNCH_BLOCKING
    CUBLAS_WORKSPACE_CONFIG PYTORCH_CUDA_ALLOC_CONF HIP_VISIBLE_DEVICES ROCR_VISIBLE_DEVICES TZ
    """.split()  # noqa: SIM905 - words are easier to read than a list of 20 quoted ones
)
# Options of sbatch that choose resources (from Slurm's manual). Others can run a program
# (task_prolog), start a container, or pass on variables (export).
SBATCH_RESOURCES = frozenset(
    """
    account begin clusters comment constraint contiguous core_spec cores_per_socket cpu_freq
    cpus_per_gpu cpus_per_task deadline dependency exclude exclusive gpu_bind gpu_freq gpus
    gpus_per_node gpus_per_socket gpus_per_task gres gres_flags hint hold licenses mail_type
    mail_user mem mem_bind mem_per_cpu mem_per_gpu mincpus network nice nodelist nodes ntasks
    ntasks_per_core ntasks_per_gpu ntasks_per_node ntasks_per_socket overcommit oversubscribe
    partition prefer priority qos requeue reservation signal sockets_per_node spread_job switches
    thread_spec threads_per_core time time_min tmp use_min_nodes wckey
    """.split()  # noqa: SIM905
)
UNQUOTED = re.compile(r"[\w./:+-]+")  # a name that needs no quotes in a list on the command line

# ---- Hydra's own settings
SPECIAL_KEYS = (  # keys by which Hydra instantiates objects, beside _target_
    "_recursive_",
    "_convert_",
    "_args_",
    "_partial_",
    "_isolate_",
    "_execution_whitelist_",
)
HYDRAS_CALLBACKS = tuple(
    f"hydra.experimental.callbacks.{name}"
    for name in ("LogJobReturnCallback", "PickleJobInfoCallback")
)
# Hydra's nodes of which plug-ins and loggers are made. What an installed package writes there is
# trusted.
MADE_NODES = ("launcher", "sweeper", "job_logging", "hydra_logging")
CLASS_KEYS = (TARGET, "class", "()")  # Hydra's and logging's keys of import paths
# Keys whose texts start nothing: resources, names and directions, and how a log line looks. In a
# plug-in any other text may be a line for a shell, a module or a server whose answers are
# unpickled; in a logger, a file to append to.
PLUGIN_TEXTS = SBATCH_RESOURCES | {
    "name",
    "direction",
    "study_name",
    "timeout",
    "pre_dispatch",
    "backend",
}
LOGGING_TEXTS = ("level", "format", "datefmt", "style", "handlers", "formatter")
# streams; a Ray cluster of this machine
FREE_TEXTS = ("ext://sys.stdout", "ext://sys.stderr", "auto", "local")
# parts of a sweeper that are words of its jobs, checked as such
SWEPT_TEXTS = ("params", "grids", "search_space")
# Resolvers that make only texts and numbers. Resolvers that turn texts into mappings (oc.create,
# oc.decode, oc.dict) could create a `_target_` after the check; resolvers of plug-ins could do
# anything.
RESOLVERS = ("hydra", "now", "oc.env", "oc.select", "python_version")
# Hydra 1.4's own values, whose resolvers join the words of a job. With arguments they would call
# other resolvers.
HYDRAS_VALUES = ("${hydra_override_dirname:}", "${hydra_deprecated_override_dirname:}")
# Classes of this form are not imported for the check, since an import may take seconds.
PUBLIC_CLASS = re.compile(rf"{PACKAGE}\.\w+\.[A-Z]\w*")
# Settings that a sweep in a file may not vary: its jobs are composed after the check of the whole
# configuration.
NOT_SWEPT = re.compile(rf"[\s+~]*(hydra|runs|{PERMISSIONS})\s*([./@:=\[]|$)")


def is_allowed(target: str, allowed: Sequence[str]) -> bool:
    """Return whether ``target``, a class's import path, is one of ``allowed`` or below one."""
    return any(
        target == prefix or target.startswith(prefix.rstrip(".") + ".") for prefix in allowed
    )


def permission_advice(missing: Sequence[str], allowed: Sequence[str]) -> str:
    """Advice for an error: the ``allow_targets=[…]`` that allows ``missing`` and ``allowed``."""
    names = [
        name if UNQUOTED.fullmatch(name) else repr(name)
        for name in dict.fromkeys([*allowed, *missing])
    ]
    return f"add allow_targets=[{','.join(names)}] to the command; no file can allow it"


def check_target(
    target: str | None, group: str, allowed: Sequence[str], own: Sequence[str] = (PACKAGE,)
) -> None:
    """Refuse a ``_target_`` outside ``own`` and ``allowed``: importing it would run its code."""
    if not target:
        raise InputError(f"{group} names no _target_: the class to use")
    if is_allowed(target, (*own, *allowed)) and target != PACKAGE:
        return
    prefix = target.split(".")[0]
    if prefix == PACKAGE:
        raise InputError(f"{group}.{TARGET}={target} is not a class for {group}")
    near = did_you_mean(prefix, allowed)
    advice = permission_advice([prefix], allowed)
    raise InputError(
        f"{group}.{TARGET}={target} is not gsbench's own{near}; if you trust that code, {advice}"
    )


def load_class(target: str, group: str, allowed: Sequence[str]) -> Any:
    """Load the class at the import path ``target``.

    Raises InputError unless it is gsbench's or ``allowed``.
    """
    check_target(target, group, allowed)
    module_name, _, name = target.rpartition(".")
    missing = object()
    try:
        module = importlib.import_module(module_name)
        cls = getattr(module, name, missing)
    # importing a user's file runs it: it may raise anything
    except (Exception, SystemExit) as error:
        reason = f"{type(error).__name__}: {error}{_import_advice(error)}"
        raise InputError(f"{group}.{TARGET}={target} cannot be imported ({reason})") from error
    if cls is missing:
        raise InputError(
            f"{group}.{TARGET}={target} cannot be imported: {module_name} has no "
            f"{name}{did_you_mean(name, dir(module))}"
        )
    # A name that an allowed module merely imports (`mine.Popen`) is the code of another module.
    defined_as = f"{getattr(cls, '__module__', None)}.{getattr(cls, '__qualname__', name)}"
    if isinstance(cls, type) and not is_allowed(defined_as, (PACKAGE, *allowed)):
        advice = permission_advice([defined_as.split(".")[0]], allowed)
        raise InputError(
            f"{group}.{TARGET}={target} is {defined_as}; if you trust that code, {advice}"
        )
    return cls


def _import_advice(error: BaseException) -> str:
    """Advice for a missing module that lies elsewhere, or beside an allowed one; else ""."""
    if not isinstance(error, ModuleNotFoundError):
        return ""
    name, folders = (error.name or "").split(".")[0], allowed_modules()
    if name in folders:
        return f"; your modules are looked for where the command is given: {folders[name]}"
    if name and any(
        Path(place, f"{name}.py").is_file() or Path(place, name).is_dir()
        for place in folders.values()
    ):
        return (
            "; it lies here, but only what allow_targets names is imported from here: add "
            f"{name} there"
        )
    return ""


def check_permissions(values: Mapping[str, Any]) -> None:
    """Refuse a trial's resolved configuration that would run what its ``allow_targets`` lacks.

    This is the last check, of plain values, from any file or command line. Raises InputError.
    """
    allowed = values.get(PERMISSIONS) or []
    # At any depth: an allowed class may build the classes that its own options name.
    for place, target in targets_in(values):
        group = ".".join(place)
        check_target(target, group, allowed, packages_allowed_at(place))
    if is_external(values["densify"]):
        check_program(values["densify"], allowed)
    _check_launch(values["launch"], allowed)
    tracking = values["tracking"]
    if tracking.get("enabled", True) and (address := foreign_address(tracking, allowed)):
        raise InputError(
            f"results would go to {address}, which only a file names; if you trust it, "
            f"{permission_advice([address], allowed)}; tracking=none sends nothing"
        )


def packages_allowed_at(place: Sequence[str]) -> tuple[str, ...]:
    """The packages of gsbench whose classes a setting at ``place`` may name without permission."""
    if len(place) == 1 and place[0] in COMPONENTS:
        own = f"{PACKAGE}.{place[0]}"
        return (own, f"{PACKAGE}.external") if place[0] == "densify" else (own,)
    if len(place) == 3 and tuple(place[:2]) == ("eval", "extra"):
        return (f"{PACKAGE}.eval",)
    return ()


def check_composed(
    config: DictConfig, allowed: Sequence[str], installed: Mapping[str, Any]
) -> None:
    """Refuse a composed configuration, with Hydra's node, that would run what is not ``allowed``.

    ``installed`` has Hydra's nodes as the installed packages alone write them for the same choices.
    The values are checked before ``${…}`` is resolved. An interpolation that could change what runs
    is refused. Raises InputError.
    """
    raw: Any = OmegaConf.to_container(config, resolve=False)
    if "hydra" in raw:  # Hydra removes its node when it runs a job
        foreign = {name: _differing(raw["hydra"][name], installed.get(name)) for name in MADE_NODES}
        raw["hydra"] = raw["hydra"] | foreign
        _check_hydra(raw["hydra"], allowed)
    for place, key, value in entries_of(raw):
        if isinstance(value, str) and "${" in value:
            _check_interpolation(place, key, value)
        if key in SPECIAL_KEYS:  # `_partial_` makes a function of anything, to be called later
            raise InputError(
                f"{'.'.join((*place, key))}: gsbench makes no objects this way: leave it out"
            )
    for place, target in targets_in(raw):
        _check_place(place, target, allowed)
    if "hydra" in raw:
        _check_written(raw, {"hydra": installed})


def _check_written(raw: Mapping[str, Any], installed: Mapping[str, Any]) -> None:
    """Refuse a place to write that is neither gsbench's own nor typed."""
    words = [word for own in raw["hydra"]["overrides"].values() for word in own]
    typed = {word.partition("=")[0].lstrip("+~") for word in words}
    for key, own in WRITTEN.items():
        given, usual = (_value_at(key, values) for values in (raw, installed))
        if key not in typed and given not in (None, own or usual):
            raise InputError(
                f"a file sets {key}={given}, a place to write: type it on the command line"
            )


def _value_at(key: str, values: Any) -> Any:
    """The value of a dotted ``key``; None without it."""
    for part in key.split("."):
        values = values.get(part) if isinstance(values, Mapping) else None
    return values


def _differing(given: Any, installed: Any) -> Any:
    """The part of ``given`` that differs from ``installed``: entries of a mapping, or all."""
    if not isinstance(given, dict) or not isinstance(installed, dict):
        return given
    differing = {
        key: value
        for key, value in given.items()
        if key not in installed or value != installed[key]
    }
    return {key: _differing(value, installed.get(key)) for key, value in differing.items()}


def _check_interpolation(place: tuple[str, ...], key: str, value: str) -> None:
    where = ".".join((*place, key))
    if place == ("hydra", "job") and value in HYDRAS_VALUES:
        return
    if key.startswith("_") and key.endswith("_"):  # the checked name would not be the imported one
        raise InputError(
            f"{where}={value}: write the name itself here, since ${{…}} may become another"
        )
    try:
        resolvers = list(_resolvers(parse(value)))
    # OmegaConf cannot resolve it either, and says so when the value is read
    except GrammarParseError:
        return
    for name in resolvers:
        if name not in RESOLVERS:
            raise InputError(
                f"{where}={value}: ${{{name}:…}} is not resolved here, only {', '.join(RESOLVERS)}"
            )


def _resolvers(tree: Any) -> Iterator[str]:
    """The names of the resolvers in a parsed text.

    A name that is itself an interpolation is yielded as written.
    """
    if type(tree).__name__ == "ResolverNameContext":
        yield tree.getText()
    for child in getattr(tree, "children", None) or []:
        yield from _resolvers(child)


def _check_place(place: tuple[str, ...], target: Any, allowed: Sequence[str]) -> None:
    """Refuse a ``target`` that its ``place`` may not name: Hydra would import and call it."""
    if not isinstance(target, str) or target == "???":
        return  # the schema or Hydra reports these
    group = ".".join(place)
    # gsbench's classes are allowed in their own group only: `densify._target_=gsbench.init.…` is
    # refused.
    own = (
        HYDRAS_CALLBACKS
        if place[:2] == ("hydra", "callbacks") and len(place) == 3
        else packages_allowed_at(place)
    )
    check_target(target, group, allowed, own)
    if is_allowed(target, (PACKAGE,)) and not PUBLIC_CLASS.fullmatch(target):
        load_class(target, group, allowed)  # refuses names such as gsbench.densify.adc.torch.load


def _check_hydra(hydra: Mapping[str, Any], allowed: Sequence[str]) -> None:
    """Refuse Hydra's own settings that would start code.

    In ``hydra``, `MADE_NODES` hold only what no installed package wrote.
    """
    # A variable can name a file that Python, a library or a program loads, and no list of harmless
    # ones is complete.
    if hydra["job"].get("env_set"):
        raise InputError(
            "hydra.job.env_set can change what runs: set variables in the shell, before the command"
        )
    for place, key, value in entries_of(
        {name: hydra[name] for name in ("callbacks", *MADE_NODES)}, ("hydra",)
    ):
        where = ".".join((*place, key))
        name = key if len(place) == 1 else place[1]
        if (*place, key)[1:3] in [("sweeper", part) for part in SWEPT_TEXTS]:
            # A job is composed after this check, and its words could name packages to import
            # configurations from.
            for text in (key, value):
                if isinstance(text, str) and NOT_SWEPT.match(text):
                    raise InputError(
                        f"{'.'.join(place)}: {text} cannot differ from job to job, and no file can "
                        "allow it: type it on the command line"
                    )
        elif isinstance(value, str) and "${" in value:
            # may become a class
            raise InputError(f"{where}: write the settings themselves here, without ${{…}}")
        elif name in MADE_NODES and isinstance(value, str):
            _check_text(where, name, key if not key.isdigit() else place[-1], value, allowed)


def _check_text(where: str, node: str, key: str, text: str, allowed: Sequence[str]) -> None:
    """Refuse a ``text`` that a plug-in or logger could take for code or a file.

    Call it only for a text that no installed package wrote.
    """
    is_logging = node.endswith("_logging")
    if key in CLASS_KEYS:
        if not is_allowed(text, allowed):
            advice = permission_advice([text.split(".")[0]], allowed)
            raise InputError(
                f"{where}={text} is not what a package set; if you trust that code, {advice}"
            )
        return
    if (
        is_allowed(f"hydra.{node}", allowed)
        or where.startswith("hydra.sweeper.tune.")
        or text in FREE_TEXTS
    ):
        return
    # In any text, logging imports the name after ext://.
    if (
        "://" in text
        or not text.isprintable()
        or key not in (LOGGING_TEXTS if is_logging else PLUGIN_TEXTS)
    ):
        advice = permission_advice([f"hydra.{node}"], allowed)
        raise InputError(
            f"{where}={text!r} could start code or write a file; if you trust it, {advice}"
        )


def load_callbacks(callbacks: Any, allowed: Sequence[str]) -> None:
    """Import the callback classes that ``hydra.callbacks`` names.

    Raises InputError for anything else.
    """
    from hydra.experimental.callback import Callback

    for name, callback in (callbacks or {}).items():
        if not isinstance(callback, Mapping) or not callback.get(TARGET):
            raise InputError(f"hydra.callbacks.{name} names no {TARGET}: the class to use")
        for place, target in targets_in(callback, ("hydra", "callbacks", str(name))):
            cls = load_class(target, ".".join(place), [*allowed, *HYDRAS_CALLBACKS])
            if not isinstance(cls, type) or (len(place) == 3 and not issubclass(cls, Callback)):
                wanted = (
                    "a class of hydra.experimental.callback.Callback"
                    if len(place) == 3
                    else "a class"
                )
                raise InputError(f"{'.'.join(place)}.{TARGET}={target} is not {wanted}")


def is_external(densify: Mapping[str, Any]) -> bool:
    """Return whether these settings make another program the trainer.

    They do if their class has one of the import paths `EXTERNAL`.
    """
    return densify.get(TARGET) in EXTERNAL


def check_program(settings: Mapping[str, Any], allowed: Sequence[str]) -> None:
    """Refuse a program as trainer unless the user allowed its programs and variables."""
    # A YAML file may call any program of this machine a trainer, or load code into one by a
    # variable.
    options = settings.get("options") or {}
    programs = [program_of(settings.get("command") or "", options)]
    if settings.get("version_command") is not None:
        programs.append(program_of(settings["version_command"], options, "densify.version_command"))
    programs = [program for program in dict.fromkeys(programs) if program not in allowed]
    variables = foreign_variables(settings.get("environment") or {}, allowed)
    if not programs and not variables:
        return
    runs = [f"runs the program {' and '.join(map(repr, programs))}"] * bool(programs)
    sets = ["sets " + ", ".join(f"{name}={value!r}" for name, value in variables.items())] * bool(
        variables
    )
    raise InputError(
        f"densify={settings['name']} {' and '.join(runs + sets)}; if you trust it, "
        + permission_advice([*programs, *variables], allowed)
    )


def foreign_variables(variables: Mapping[str, Any], allowed: Sequence[str]) -> dict[str, Any]:
    """The ``variables`` that may not be set: neither free nor allowed nor at this value already."""
    return {
        name: value
        for name, value in variables.items()
        if name not in FREE_VARIABLES and name not in allowed and value != os.environ.get(name)
    }


def _check_launch(launch: Mapping[str, Any], allowed: Sequence[str]) -> None:
    """Refuse lines for a shell, and values that could become one in the script that Slurm runs."""
    if launch.get("setup") and SHELL not in allowed:
        raise InputError(
            f"launch.setup runs {'; '.join(map(str, launch['setup']))!r} in a shell; if you trust "
            "it, " + permission_advice([SHELL], allowed)
        )
    options = {
        str(name).replace("-", "_"): value for name, value in (launch.get("sbatch") or {}).items()
    }
    if (not_resources := sorted(options.keys() - SBATCH_RESOURCES)) and SBATCH not in allowed:
        raise InputError(
            f"launch.sbatch.{not_resources[0]} chooses more than resources; if you trust it, "
            + permission_advice([SBATCH], allowed)
        )
    texts = {f"launch.{name}": launch.get(name) for name in ("partition", "account", "qos")}
    texts |= {f"launch.sbatch.{name}": value for name, value in options.items()}
    # a line break would end the comment that Slurm reads, and begin a command
    for key, value in texts.items():
        if not str(value).isprintable() or not key.isprintable():
            raise InputError(f"{key} must be one line, got {value!r}")
