"""A trial's folder: where it lies, in which state it is, and whether its results still hold. Loads no torch."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import yaml

from gsbench.errors import InputError
from gsbench.files import read_object, write_json
from gsbench.runs.hashing import config_hash, sha256_of
from gsbench.runs.layout import BUILDING, CONFIG, CURVES, FAILED, INPUTS, LOCK, RESULTS
from gsbench.runs.stages import STAGES
from gsbench.runs.store import read_manifest
from gsbench.system.locks import is_held

TAIL_BYTES = 4096
INPUTS_VERSION = 1

State = Literal["done", "running", "failed", "partial", "missing"]


@dataclass(frozen=True)
class TrialPaths:
    """Where a trial's files lie."""

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
    """How far a trial is, from its folder alone."""
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
    """Why a trial failed, in one line."""
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


def record_inputs(
    folder: Path,
    values: dict[str, Any],
    results: dict[str, Any],
    sources: Iterable[Path],
    entries: Mapping[str, Path],
    published: Iterable[Path],
) -> None:
    """Write down what ``find_finished`` needs: source files, stage results by name, files shown in ``folder``."""
    sources = list(sources)
    folders = sorted({path.parent for path in sources})  # their time of change tells of files that came or went
    record = {
        "version": INPUTS_VERSION,
        "config": config_hash(values),
        "results": sha256_of(results),
        "stages": {stage.name: stage.version for stage in STAGES},
        "pycolmap": _version("pycolmap"),
        "sources": {str(path): _stamp(path) for path in sorted(sources)},
        "folders": {str(path): path.stat().st_mtime_ns for path in folders},
        "entries": {name: str(path) for name, path in entries.items()},
        "published": {path.relative_to(folder).as_posix(): _stamp(path) for path in published},
    }
    write_json(folder / INPUTS, record)


def find_finished(
    values: dict[str, Any], unavailable_now: Callable[[dict[str, Any]], Collection[str]] = lambda options: ()
) -> dict[str, Any] | None:
    """What ``results.json`` holds if the trial is done and nothing that it was made of has changed; else None.

    Quick, since files are compared by size and time of change. A trial that lacks a metric for want of weights is done
    only if ``unavailable_now``, called with the ``eval`` settings, says that it would lack it again.
    """
    folder = TrialPaths.of(values).folder
    results, record = read_object(folder / RESULTS), read_object(folder / INPUTS)
    try:
        if results["status"] != "complete" or results["hashes"]["config"] != config_hash(values):
            return None
        lacking = set(results["awaited"])  # metrics that may still come, once their weights or packages are there
        same = (
            record["version"] == INPUTS_VERSION
            and record["config"] == config_hash(values)
            and record["results"] == sha256_of(results)
            and record["stages"] == {stage.name: stage.version for stage in STAGES}
            and record["pycolmap"] == _version("pycolmap")
            and all(_stamp(Path(path)) == stamp for path, stamp in record["sources"].items())
            and all(Path(path).stat().st_mtime_ns == changed for path, changed in record["folders"].items())
            and all(_stamp(folder / name) == stamp for name, stamp in record["published"].items())
        )
        if same:
            for path in record["entries"].values():
                read_manifest(Path(path))
        same = same and (not lacking or lacking <= set(unavailable_now(values["eval"])))
    except (KeyError, TypeError, AttributeError, ValueError, OSError):
        return None
    return results if same else None


def _stamp(path: Path) -> list[int]:
    state = os.stat(path)
    return [state.st_size, state.st_mtime_ns]


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
