"""A trial's folder: where it lies, and in which state it is. Loads no torch."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from gsbench.errors import InputError
from gsbench.files import read_object
from gsbench.runs.hashing import config_hash
from gsbench.runs.layout import BUILDING, CONFIG, CURVES, FAILED, LOCK, RESULTS
from gsbench.system.locks import is_held

TAIL_BYTES = 4096

State = Literal["done", "running", "failed", "partial", "missing"]


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
        leaf = f"{config_hash(values)[:8]}-seed{values['seed']}"
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
    hash8, _, seed = folder.name.partition("-seed")
    return f"{folder.parent.parent.name}/{folder.parent.name} seed {seed} ({hash8})"


def state_of(folder: Path) -> State:
    """The state of a trial, from its folder alone."""
    if is_held(folder / LOCK):
        return "running"
    if read_object(folder / RESULTS).get("status") == "complete":
        return "done"
    if (folder / FAILED).exists():
        return "failed"
    return "partial" if (folder / CONFIG).exists() else "missing"


def read_config(folder: Path) -> dict[str, Any]:
    """The configuration that a trial wrote, which allows nothing to run; raises InputError where it cannot be read."""
    try:
        values = yaml.safe_load((folder / CONFIG).read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError) as error:
        raise InputError(f"{folder / CONFIG} cannot be read ({error})") from error
    if not isinstance(values, dict) or not isinstance(values.get("tracking"), dict):
        raise InputError(f"{folder / CONFIG} is not the configuration of a trial")
    return values | {"allow_targets": []}  # permission comes from the one who types


def failure_of(folder: Path) -> str:
    """The reason why a trial failed, in one line."""
    record = read_object(folder / FAILED)
    text = str(record.get("message") or record.get("error") or "failed.json cannot be read").strip()
    return text.splitlines()[0] if text else "no reason was given"


def stage_and_step(folder: Path) -> tuple[str, int]:
    """The stage that an unfinished trial is at ("" if none has begun), and the last iteration that it logged."""
    building = read_object(folder / BUILDING)
    try:
        with Path(building["folder"], CURVES).open("rb") as stream:
            stream.seek(0, os.SEEK_END)
            stream.seek(max(0, stream.tell() - TAIL_BYTES))
            steps = re.findall(rb'"step": (\d+)', stream.read())
    except (OSError, KeyError, TypeError):
        steps = []
    return str(building.get("stage", "")), int(steps[-1]) if steps else 0
