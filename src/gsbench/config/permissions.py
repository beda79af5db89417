"""The classes that may run: gsbench's own, each in its group, and what the command line allows.

Only the command line gives permission; no file can. ``allow_targets`` names modules (``mine``),
programs (``bash``), environment variables (``PATH``) and addresses.
"""

import importlib
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.runs.nested import TARGET
from gsbench.system.own_modules import allowed_modules
from gsbench.words import did_you_mean

PACKAGE = "gsbench"
# groups that name one class each; `eval.extra` names any number
COMPONENTS = ("init", "densify", "raster", "tracking")
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
    """The packages of gsbench whose classes a setting at ``place`` may name without permission."""
    if len(place) == 1 and place[0] in COMPONENTS:
        own = f"{PACKAGE}.{place[0]}"
        return (own, f"{PACKAGE}.external") if place[0] == "densify" else (own,)
    if len(place) == 3 and tuple(place[:2]) == ("eval", "extra"):
        return (f"{PACKAGE}.eval",)
    return ()
