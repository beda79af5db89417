"""A trial's folder: where it lies, and in which state it is. Loads no torch."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic_core import to_json

from gsbench.errors import InputError
from gsbench.parsing import DamagedError, one_line, read_tail, read_yaml
from gsbench.records import Amount, Count, Part, read_if_sound, typed
from gsbench.runs.hashing import config_hash
from gsbench.runs.inputs import read_results
from gsbench.runs.layout import BUILDING, CONFIG, CURVES, FAILED, LOCK, SEED
from gsbench.settings import FolderName
from gsbench.system.locks import is_held

TAIL_BYTES = 4096

State = Literal["done", "running", "failed", "partial", "damaged", "missing"]


@dataclass(frozen=True, kw_only=True)
class Named(Part):
    """A group of the configuration, of which the name is asked for."""

    name: FolderName


@dataclass(frozen=True, kw_only=True)
class Tracked(Part):
    """Settings of the group ``tracking`` that mirroring a trial later needs."""

    uri: str | None
    flush_seconds: Amount
    patience_seconds: Amount
    images: Count


@dataclass(frozen=True, kw_only=True)
class Configured(Part):
    """Keys that a trial's ``config.yaml`` must have to be used at all; `gsbench.config.schema` has the rest."""

    name: FolderName
    seed: Count
    runs: str
    scene: Named
    init: Named
    densify: Named
    tracking: Tracked


@dataclass(frozen=True, kw_only=True)
class Failure(Part):
    """``failed.json``: the kind of the error, its text, where it came from, and when (Unix time)."""

    error: str = ""
    message: str = ""
    traceback: str = field(default="", repr=False)
    time: Amount = 0.0
    seed: Count = 0

    @property
    def reason(self) -> str:
        """The first line of the text."""
        lines = (self.message or self.error).strip().splitlines()
        return one_line(lines[0]) if lines else "no reason was given"


@dataclass(frozen=True, kw_only=True)
class Building(Part):
    """``building.json``: the stage that an unfinished trial is at, and the folder where it is built."""

    stage: str = ""
    folder: str = ""


@dataclass(frozen=True)
class TrialPaths:
    """Paths of a trial's files."""

    runs: Path
    folder: Path

    @classmethod
    def of(cls, values: dict[str, Any]) -> TrialPaths:
        """The folders of the trial with the resolved configuration ``values``."""
        runs = Path(values["runs"]).expanduser().resolve()
        arm = f"{values['init']['name']}-{values['densify']['name']}"
        leaf = f"{config_hash(values)[:8]}{SEED}{values['seed']}"
        return cls(runs, runs / values["name"] / values["scene"]["name"] / arm / leaf)

    @property
    def home(self) -> Path:
        """The experiment's folder."""
        return self.folder.parents[2]

    @property
    def lock(self) -> Path:
        return self.folder / LOCK

    @property
    def label(self) -> str:
        """Scene, arm and seed, for people."""
        return label_of(self.folder)


def label_of(folder: Path) -> str:
    """Scene, arm and seed of a trial's folder, for people."""
    hash8, _, seed = folder.name.partition(SEED)
    return f"{folder.parent.parent.name}/{folder.parent.name} seed {seed} ({hash8})"


def state_of(folder: Path) -> State:
    """The state of a trial, from its folder alone."""
    if is_held(folder / LOCK):
        return "running"
    try:
        read_results(folder)
        return "done"
    except FileNotFoundError:
        pass
    except DamagedError:
        return "damaged"
    if (folder / FAILED).exists():
        return "failed"
    return "partial" if (folder / CONFIG).exists() else "missing"


def read_config(folder: Path) -> dict[str, Any]:
    """The configuration that a trial wrote, which allows nothing to run; raises InputError where it cannot be read."""
    path = folder / CONFIG
    try:
        values = read_yaml(path)
    except FileNotFoundError:
        raise InputError(f"{path} is not there: give the command of the trial again") from None
    typed(to_json(values), Configured, path)
    return values | {"allow_targets": []}  # permission comes from the one who types


def failure_of(folder: Path) -> str:
    """The reason why a trial failed, in one line."""
    failure = read_if_sound(folder / FAILED, Failure)
    return f"{FAILED} cannot be read" if failure is None else failure.reason


def read_building(folder: Path) -> Building:
    """The stage that the trial in ``folder`` is at; nothing said where it is at none, or that cannot be read."""
    return read_if_sound(folder / BUILDING, Building) or Building()


def stage_and_step(folder: Path) -> tuple[str, int]:
    """The stage that an unfinished trial is at ("" if none has begun), and the last iteration that it logged."""
    building = read_building(folder)
    try:
        tail = read_tail(Path(building.folder, CURVES), TAIL_BYTES) if building.folder else b""
    except (FileNotFoundError, DamagedError):
        tail = b""
    steps = re.findall(rb'"step": (\d{1,18})', tail)
    return building.stage, int(steps[-1]) if steps else 0
