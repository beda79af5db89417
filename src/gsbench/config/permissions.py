"""All that a configuration may run, set and read: gsbench's own, and what the command line allows.

Only the command line gives permission; no file can. ``allow_targets`` names modules (``mine``),
programs (``bash``), variables (``PATH`` to set one, ``env:PATH`` to read it) and addresses. Loads
no Hydra.
"""

import importlib
import os
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf.errors import GrammarParseError
from omegaconf.grammar_parser import parse

from gsbench.errors import InputError
from gsbench.external.settings import program_of
from gsbench.parsing import table_beside
from gsbench.runs.configuration import TARGET, entries_of
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
