"""All that a configuration may run, set, read, reach and overwrite.

gsbench's own is allowed, and what the command line allows: only the command line gives permission,
no file can. ``allow_targets`` names modules (``mine``), programs (``bash``), variables (``PATH`` to
set one, ``env:PATH`` to read it) and addresses.

`check_composed` checks a composed configuration, Hydra's own settings included, before Hydra makes
any object of it. `check_permissions` checks the resolved values of each trial before its parts are
made. `docs/security.md` says what this protects from. Loads no Hydra by itself.
"""

import importlib
import os
import re
import shlex
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import GrammarParseError
from omegaconf.grammar_parser import parse

from gsbench.errors import InputError
from gsbench.external.settings import program_of
from gsbench.parsing import table_beside
from gsbench.runs.code import PERMISSIONS
from gsbench.runs.configuration import TARGET, entries_of, targets_in
from gsbench.system.programs import allowed_modules
from gsbench.words import did_you_mean

PACKAGE = "gsbench"
# groups that name one class each; `eval.extra` names any number
COMPONENTS = ("init", "densify", "raster", "tracking")
# lists of all that needs no permission
ALLOWED: dict[str, list[str]] = table_beside(__file__, "allowed.yaml")
UNQUOTED = re.compile(r"[\w./:+-]+")  # a name that needs no quotes in a list on the command line


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
    word = f"allow_targets=[{','.join(names)}]"
    # A shell would run what is in $(…) or behind a quote in a stranger's name.
    if any(not UNQUOTED.fullmatch(name) for name in (*allowed, *missing)):
        word = shlex.quote(word) if set(word) & set('$`"\\!') else f'"{word}"'
    return f"add {word} to the command; no file can allow it"


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


def packages_allowed_at(place: Sequence[str]) -> tuple[str, ...]:
    """gsbench's packages and classes that a setting at ``place`` may name without permission."""
    if len(place) == 1 and place[0] in COMPONENTS:
        own = f"{PACKAGE}.{place[0]}"
        return (own, *ALLOWED["external"]) if place[0] == "densify" else (own,)
    if len(place) == 3 and tuple(place[:2]) == ("eval", "extra"):
        return (f"{PACKAGE}.eval",)
    return ()


# ---- programs, shell lines, options of Slurm, and variables

# the permissions for shell lines, and for unusual options of Slurm
SHELL, SBATCH = "bash", "sbatch"
OWN_VARIABLES = "GSBENCH_"


def is_external(densify: Mapping[str, Any]) -> bool:
    """Return whether these settings make another program the trainer.

    They do if their class has one of the import paths ``external`` in ``allowed.yaml``.
    """
    return densify.get(TARGET) in ALLOWED["external"]


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
    acts = []
    if programs:
        acts.append(f"runs the program {' and '.join(map(repr, programs))}")
    if variables:
        acts.append("sets " + ", ".join(f"{name}={value!r}" for name, value in variables.items()))
    if acts:
        raise InputError(
            f"densify={settings['name']} {' and '.join(acts)}; if you trust it, "
            + permission_advice([*programs, *variables], allowed)
        )


def foreign_variables(variables: Mapping[str, Any], allowed: Sequence[str]) -> dict[str, Any]:
    """The ``variables`` that may not be set: neither free nor allowed nor at this value already."""
    return {
        name: value
        for name, value in variables.items()
        if name not in (*ALLOWED["variables"], *allowed) and value != os.environ.get(name)
    }


def reading(variable: str) -> str:
    """The permission to read a variable: another word than the one that allows to set it."""
    return f"env:{variable}"


def is_readable(variable: str, allowed: Sequence[str]) -> bool:
    """Return whether a configuration may read the variable, so that results have its value."""
    return (
        variable in ALLOWED["variables"] + ALLOWED["readable"]
        or variable.startswith(OWN_VARIABLES)
        or reading(variable) in allowed
    )


def check_launch(launch: Mapping[str, Any], allowed: Sequence[str]) -> None:
    """Refuse lines for a shell, and values that could become one in the script that Slurm runs."""
    if launch.get("setup") and SHELL not in allowed:
        raise InputError(
            f"launch.setup runs {'; '.join(map(str, launch['setup']))!r} in a shell; if you trust "
            "it, " + permission_advice([SHELL], allowed)
        )
    options = {
        str(name).replace("-", "_"): value for name, value in (launch.get("sbatch") or {}).items()
    }
    if (not_resources := sorted(options.keys() - set(ALLOWED["sbatch"]))) and SBATCH not in allowed:
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


# ---- limits of ${…}, by whomever it was written


def check_texts(values: Any, allowed: Sequence[str], file: str = "") -> None:
    """Refuse a ``${…}`` at any depth of ``values``, also in a key, that may not be resolved.

    ``file`` is named in the InputError.
    """
    for place, key, value in entries_of(values):
        where = f"{file}: " * bool(file) + ".".join((*place, key))
        for text in (key, value):
            if isinstance(text, str) and "${" in text:
                _check_interpolation(where, key, text, allowed)


def _check_interpolation(where: str, key: str, value: str, allowed: Sequence[str]) -> None:
    if key.startswith("_") and key.endswith("_"):  # the checked name would not be the imported one
        raise InputError(
            f"{where}={value}: write the name itself here, since ${{…}} may become another"
        )
    try:
        calls = list(_calls(parse(value)))
    # OmegaConf cannot resolve it either, and says so when the value is read
    except GrammarParseError:
        return
    for name, first in calls:
        if name not in ALLOWED["resolvers"]:
            raise InputError(
                f"{where}={value}: ${{{name}:…}} is not resolved here, only "
                f"{', '.join(ALLOWED['resolvers'])}"
            )
        # Its value would stand in results, archives and trackers, where others read it.
        if name == "oc.env" and not is_readable(first, allowed):
            advice = permission_advice([reading(first)], allowed)
            raise InputError(
                f"{where}={value} reads the variable {first}, which may be secret; if you want "
                f"its value in results, {advice}"
            )


def _calls(tree: Any) -> Iterator[tuple[str, str]]:
    """The resolvers in a parsed text, each with its first argument.

    What is itself an interpolation is yielded as written.
    """
    parts = list(getattr(tree, "children", None) or [])
    for name, *rest in (parts[k:] for k in range(len(parts))):
        if type(name).__name__ == "ResolverNameContext":
            listed = [part for part in rest if type(part).__name__ == "SequenceContext"]
            first = listed[0].getChild(0).getText() if listed else ""
            yield name.getText(), first.strip().strip("'\"")
        yield from _calls(name)


# ---- whole configurations

OWN_RUNS = "${oc.env:GSBENCH_RUNS,runs}"

# Hydra's nodes of which plug-ins and loggers are made. What an installed package writes there is
# trusted.
MADE_NODES = ("launcher", "sweeper", "job_logging", "hydra_logging")
CLASS_KEYS = ("class", "()")  # logging's keys of import paths
# Classes of this form are not imported for the check, since an import may take seconds.
PUBLIC_CLASS = re.compile(rf"{PACKAGE}\.\w+\.[A-Z]\w*")
# Settings that a sweep in a file may not vary: its jobs are composed after the check of the whole
# configuration.
NOT_SWEPT = re.compile(rf"[\s+~]*(hydra|runs|{PERMISSIONS})\s*([./@:=\[]|$)")


def check_permissions(values: Mapping[str, Any]) -> None:
    """Refuse a trial's resolved configuration that would run what its ``allow_targets`` lacks.

    This is the last check, of plain values, from any file or command line. Raises InputError.
    """
    allowed = values.get(PERMISSIONS) or []
    # At any depth: an allowed class may build the classes that its own options name.
    for place, key, value in entries_of(values):
        check_key((*place, key))
        if key == TARGET and value is not None:
            check_target(value, ".".join(place), allowed, packages_allowed_at(place))
    if is_external(values["densify"]):
        check_program(values["densify"], allowed)
    check_launch(values["launch"], allowed)
    tracking = values["tracking"]
    if tracking.get("enabled", True) and (address := foreign_address(tracking, allowed)):
        raise InputError(
            f"results would go to {address}, which only a file names; if you trust it, "
            f"{permission_advice([address], allowed)}; tracking=none sends nothing"
        )


def check_key(path: Sequence[str]) -> None:
    """Refuse a key by which Hydra makes objects in another way, such as a function from a class."""
    if path[-1] in ALLOWED["special"]:
        raise InputError(f"{'.'.join(path)}: gsbench makes no objects this way: leave it out")


def foreign_address(tracking: Mapping[str, Any], allowed: Sequence[str]) -> str:
    """An address in the settings ``tracking`` that only a file names, which may not be used, or "".

    The user's own are those ``allowed`` on the command line, and those in the environment.
    """
    known = {*allowed, *map(os.environ.get, ALLOWED["addresses"])}
    given = ((key, str(value)) for key, value in tracking.items() if value)
    places = (text for key, text in given if key == "uri" or "://" in text)
    return next((place for place in places if place not in known), "")


def check_composed(
    config: DictConfig, allowed: Sequence[str], installed: Mapping[str, Any]
) -> None:
    """Refuse a composed configuration, with Hydra's node, that would run what is not ``allowed``.

    ``installed`` has Hydra's nodes as the installed packages alone write them for the same choices.
    The values are checked before ``${…}`` is resolved. An interpolation that could change what runs
    is refused. Raises InputError.
    """
    raw: Any = OmegaConf.to_container(config, resolve=False)
    usual = {
        (*place, key): value
        for place, key, value in entries_of({"runs": OWN_RUNS, "hydra": installed})
    }
    words = [word for own in raw["hydra"]["overrides"].values() for word in own]
    typed = {word.partition("=")[0].lstrip("+~") for word in words}
    for place, key, value in entries_of(raw):
        path = (*place, key)
        if usual.get(path) == value:
            continue
        if not isinstance(value, dict | list):  # files of packages were not looked at before
            check_texts({key: value}, allowed, ".".join(place))
        check_key(path)
        # The schema or Hydra reports a target that is no text.
        if key == TARGET and isinstance(value, str) and value != "???":
            is_callback = place[:2] == ("hydra", "callbacks") and len(place) == 3
            # gsbench's classes are allowed in their own group only:
            # `densify._target_=gsbench.init.…` is refused.
            own = ALLOWED["callbacks"] if is_callback else packages_allowed_at(place)
            check_target(value, ".".join(place), allowed, own)
            if is_allowed(value, (PACKAGE,)) and not PUBLIC_CLASS.fullmatch(value):
                # refuses names such as gsbench.densify.adc.torch.load
                load_class(value, ".".join(place), allowed)
        _check_hydra(path, value, typed, allowed)


def _check_hydra(
    path: tuple[str, ...], value: Any, typed: Collection[str], allowed: Sequence[str]
) -> None:
    """Refuse a setting that would start code by Hydra, or write elsewhere.

    No installed package has written it; ``typed`` are the keys of the words of the command line.
    """
    where, node = ".".join(path), path[1] if path[0] == "hydra" and len(path) > 1 else ""
    key = path[-2] if path[-1].isdigit() else path[-1]
    text = value if isinstance(value, str) else ""
    if where == "hydra.job.env_set" and value:
        # A variable can name a file that Python, a library or a program loads, and no list of
        # harmless ones is complete.
        raise InputError(
            "hydra.job.env_set can change what runs: set variables in the shell, before the command"
        )
    if where in ALLOWED["written"] and value is not None and where not in typed:
        raise InputError(
            f"a file sets {where}={value}, a place to write: type it on the command line"
        )
    if path[:2] == ("hydra", "sweeper") and path[2:3] and path[2] in ALLOWED["swept"]:
        # A job is composed after this check, and its words could name packages to import
        # configurations from.
        if swept := next(filter(NOT_SWEPT.match, (path[-1], text)), ""):
            raise InputError(
                f"{'.'.join(path[:-1])}: {swept} cannot differ from job to job, and no file can "
                "allow it: type it on the command line"
            )
        return
    if node in (*MADE_NODES, "callbacks") and "${" in text:  # may become a class
        raise InputError(f"{where}: write the settings themselves here, without ${{…}}")
    if not text or node not in MADE_NODES or key == TARGET:
        return
    # In any text, logging imports the name after ext://.
    is_plain = (
        key in ALLOWED["keys"] + ALLOWED["sbatch"] and "://" not in text and text.isprintable()
    )
    if key in CLASS_KEYS:
        if not is_allowed(text, allowed):
            advice = permission_advice([text.split(".")[0]], allowed)
            raise InputError(
                f"{where}={text} is not what a package set; if you trust that code, {advice}"
            )
    elif not is_plain and text not in ALLOWED["texts"] and not is_allowed(f"hydra.{node}", allowed):
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
            cls = load_class(target, ".".join(place), [*allowed, *ALLOWED["callbacks"]])
            base, what = (
                (Callback, "a class of hydra.experimental.callback.Callback")
                if len(place) == 3
                else (object, "a class")
            )
            if not isinstance(cls, type) or not issubclass(cls, base):
                raise InputError(f"{'.'.join(place)}.{TARGET}={target} is not {what}")
