"""``plan.json`` of an experiment: every trial that was asked for under its name, by its folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from gsbench.errors import InputError
from gsbench.files import write_json
from gsbench.parsing import DamagedError
from gsbench.records import Amount, Part, read_typed
from gsbench.runs.layout import PLAN
from gsbench.settings import is_folder_name

PLAN_VERSION = 1
LEVELS = 3  # scene, arm, trial


@dataclass(frozen=True, kw_only=True)
class Entry(Part):
    """A trial of the plan: its overrides, where the command was given, and when (Unix time)."""

    overrides: tuple[str, ...]
    cwd: str
    time: Amount


def _is_below(name: str) -> str:
    parts = name.split("/")
    if len(parts) != LEVELS or not all(map(is_folder_name, parts)):
        raise ValueError("it is no folder of a trial")
    return name


@dataclass(frozen=True, kw_only=True)
class Plan(Part):
    """The whole file; ``trials`` are by their folders as seen from the experiment's."""

    version: int
    trials: dict[Annotated[str, AfterValidator(_is_below)], Entry]


def read_entries(home: Path) -> dict[str, Entry]:
    """The planned trials of the experiment in ``home``, none if it has no plan; raises InputError for a damaged one."""
    try:
        return read_typed(home / PLAN, Plan).trials
    except FileNotFoundError:
        return {}
    except DamagedError as error:
        raise InputError(f"{error}: each command of a sweep writes it anew, with its own trials") from None


def write_entries(home: Path, entries: dict[str, Entry]) -> None:
    """Write the plan of the experiment in ``home``; the caller holds its lock."""
    plan = Plan(version=PLAN_VERSION, trials=entries)
    write_json(home / PLAN, plan.to_json())
