"""The plan of an experiment: every trial that was ever asked for under its name, so that what is missing can be named.

``<runs>/<experiment>/plan.json`` maps a trial's folder to the overrides that describe it. Loads no torch.
"""

from __future__ import annotations

import logging
import os
import shutil
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from gsbench.config.compose import Trial
from gsbench.files import require_own, write_json
from gsbench.parsing import DamagedError
from gsbench.records import Amount, Record, read_typed
from gsbench.runs.experiments import make_home
from gsbench.runs.layout import PLAN, RESULTS
from gsbench.settings import is_folder_name
from gsbench.system.locks import hold

log = logging.getLogger(__name__)

PLAN_VERSION = 1
LEVELS = 3  # scene, arm, trial


@dataclass(frozen=True, kw_only=True)
class PlannedTrial(Record):
    """A trial of the plan: its overrides, where the command was given, and when (Unix time)."""

    overrides: tuple[str, ...]
    cwd: str
    time: Amount


def _is_below(name: str) -> str:
    parts = name.split("/")
    if len(parts) != LEVELS or not all(map(is_folder_name, parts)):
        raise ValueError("it is not a folder of a trial")
    return name


@dataclass(frozen=True, kw_only=True)
class PlanFile(Record):
    """The whole file; ``trials`` are by their folders as seen from the experiment's."""

    version: int
    trials: dict[Annotated[str, AfterValidator(_is_below)], PlannedTrial]


def add_to_plan(trials: Sequence[Trial]) -> None:
    """Write the trials into the plans of their experiments; those that were there stay.

    A trial that was read from its own record stays out: its plan would hold no words, which describe the defaults.
    """
    by_home: dict[Path, dict[Path, PlannedTrial]] = {}
    for trial in trials:
        if not trial.recorded:
            planned = PlannedTrial(overrides=tuple(trial.overrides), cwd=os.getcwd(), time=time.time())
            by_home.setdefault(trial.files.home, {})[trial.folder] = planned
    for home, added in by_home.items():
        make_home(home)
        with hold(home / f".{PLAN}.lock", "the plan"):
            _write(home, read_plan(home) | added)


def forget(home: Path, folders: Iterable[Path]) -> None:
    """Drop trials from the plan of the experiment in ``home``."""
    doomed = set(folders)
    with hold(home / f".{PLAN}.lock", "the plan"):
        _write(home, {folder: trial for folder, trial in read_plan(home).items() if folder not in doomed})


def remove(home: Path, folders: Iterable[Path]) -> None:
    """Delete the folders of trials and drop them from the plan of the experiment in ``home``.

    What the stages computed stays in the store: where the old code comes back, its trials are only put together again.
    """
    folders = list(folders)
    for folder in folders:
        require_own(home.parent, folder)
        (folder / RESULTS).unlink(missing_ok=True)  # first, so that no part of a trial is ever taken for all of it
        shutil.rmtree(folder)
    forget(home, folders)


def read_plan(home: Path) -> dict[Path, PlannedTrial]:
    """The planned trials of the experiment in ``home`` by their folders; none if it has no plan.

    None either where it is damaged, which is said: trials of other commands are found by their folders, if they have
    begun.
    """
    try:
        trials = read_typed(home / PLAN, PlanFile).trials
    except FileNotFoundError:
        return {}
    except DamagedError as error:
        log.warning("left out: %s: to write it again, run the sweep's command", error)
        return {}
    return {home / name: trial for name, trial in sorted(trials.items())}


def _write(home: Path, trials: dict[Path, PlannedTrial]) -> None:
    names = {folder.relative_to(home).as_posix(): trial for folder, trial in trials.items()}
    write_json(home / PLAN, PlanFile(version=PLAN_VERSION, trials=names).to_json())
