"""The plan of an experiment: the trials of all its commands, so that missing ones can be listed.

``<runs>/<experiment>/plan.json`` maps the folder of each trial to the overrides that describe it.
"""

import logging
from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

from pydantic import AfterValidator

from gsbench.files import write_json
from gsbench.parsing import Amount, DamagedError, Raw, Record, read_typed
from gsbench.runs.experiments import make_home
from gsbench.runs.layout import PLAN
from gsbench.settings import ARM_BYTES, is_folder_name
from gsbench.system.locks import hold

log = logging.getLogger(__name__)

LEVELS = 3  # folders of scene, arm and trial


class PlannedTrial(Record):
    """A planned trial: its overrides, the folder of the command, and the Unix time."""

    overrides: tuple[Raw, ...]
    cwd: Raw
    time: Amount


def _checked_folder(name: str) -> str:
    parts = name.split("/")
    if len(parts) != LEVELS or not all(is_folder_name(part, ARM_BYTES) for part in parts):
        raise ValueError("it is not a folder of a trial")
    return name


class PlanFile(Record):
    """The file ``plan.json``: the trials by their folders within the experiment."""

    trials: dict[Annotated[str, AfterValidator(_checked_folder)], PlannedTrial]


def read_plan(home: Path) -> dict[Path, PlannedTrial]:
    """The planned trials of the experiment in ``home`` by their folders; {} without a plan.

    A damaged plan gives {} with a warning: trials that have begun are found by their folders
    anyway.
    """
    try:
        trials = read_typed(home / PLAN, PlanFile).trials
    except FileNotFoundError:
        return {}
    except DamagedError as error:
        log.warning("left out: %s: to write it again, run the sweep's command", error)
        return {}
    return {home / name: trial for name, trial in sorted(trials.items())}


def change_plan(
    home: Path,
    added: Mapping[Path, PlannedTrial] = MappingProxyType({}),
    dropped: Collection[Path] = (),
) -> None:
    """Add trials to the plan of the experiment in ``home``, or drop some by their folders."""
    make_home(home)
    with hold(home / f".{PLAN}.lock", "the plan"):
        planned = {**read_plan(home), **added}
        names = {
            folder.relative_to(home).as_posix(): trial
            for folder, trial in planned.items()
            if folder not in dropped
        }
        write_json(home / PLAN, PlanFile(trials=names).to_json())
