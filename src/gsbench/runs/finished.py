"""Test whether a trial's results still hold: what they were made of is recorded, and compared later. Loads no torch."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gsbench.parsing import DamagedError
from gsbench.runs.code import changed_files
from gsbench.runs.hashing import config_hash
from gsbench.runs.inputs import (
    INPUTS_VERSION,
    PYCOLMAP,
    Inputs,
    Stamp,
    read_inputs,
    read_results,
    source_stamp_of,
    stamp_of,
    version_of,
)
from gsbench.runs.layout import INPUTS, RESULTS
from gsbench.runs.stages import STAGES
from gsbench.runs.store import read_manifest
from gsbench.runs.trial_files import TrialPaths
from gsbench.runs.trial_record import TrialRecord, UnfinishedError

Cause = Literal["unfinished", "configuration", "record", "stage", "package", "file", "store", "metric", "code"]


@dataclass(frozen=True)
class Done:
    """State of a trial that is done and still holds; ``results`` is what ``results.json`` holds."""

    results: TrialRecord


@dataclass(frozen=True)
class NotDone:
    """State of a trial that has to be run or checked; ``reason`` says in words which file, stage, package or metric is
    the cause.
    """

    cause: Cause
    reason: str


def find_finished(
    values: dict[str, Any], unavailable_now: Callable[[dict[str, Any]], Collection[str]] = lambda options: ()
) -> Done | NotDone:
    """Tell whether the trial with the resolved configuration ``values`` is done and nothing it was made of has changed.

    Quick, since files are compared by size and times of change. A trial that lacks a metric for want of weights is done
    only if ``unavailable_now``, called with the ``eval`` settings, says that it would lack it again.
    """
    folder = TrialPaths.of(values).folder
    try:
        results, _ = read_results(folder)
    except (FileNotFoundError, UnfinishedError):
        return NotDone("unfinished", f"{RESULTS} is not there, or not complete")
    except DamagedError as error:
        return NotDone("record", f"{error.path.name} {error.reason}")
    try:
        inputs = read_inputs(folder)
    except FileNotFoundError:
        return NotDone("record", f"{INPUTS} is not there")
    except DamagedError as error:
        return NotDone("record", f"{INPUTS} {error.reason}")
    objections = _objections(folder, values, results, inputs)
    return next(objections, None) or _lacking(results, unavailable_now, values["eval"]) or Done(results)


def _objections(folder: Path, values: dict[str, Any], results: TrialRecord, inputs: Inputs) -> Iterator[NotDone]:
    """Reasons why a complete trial no longer holds, the quickest to find first."""
    present = config_hash(values)
    if results.hashes.get("config") != present or inputs.config != present:
        yield NotDone("configuration", "its results are of another configuration")
    if inputs.version != INPUTS_VERSION:
        yield NotDone("record", f"{INPUTS} was written by another version of gsbench")
    versions = {stage.name: stage.version for stage in STAGES}
    for name in sorted(versions.keys() | inputs.stages.keys()):
        made, now = inputs.stages.get(name), versions.get(name)
        if made != now:
            yield NotDone("stage", f"it was made by version {made} of the stage {name}, which is now at {now}")
    if files := changed_files(results.code.files):
        yield NotDone("code", f"the code of gsbench changed in: {', '.join(files)}")
    if inputs.pycolmap != (installed := version_of(PYCOLMAP)):
        yield NotDone("package", f"it was made with {PYCOLMAP} {inputs.pycolmap}, and {installed} is installed")
    for path, stamp in inputs.sources.items():
        yield from _file_objections(Path(path), stamp, source_stamp_of)
    for path, changed in inputs.folders.items():
        if _changed(Path(path)) != changed:
            yield NotDone("file", f"files have come to {path}, or gone from there")
    for name, stamp in inputs.published.items():
        yield from _file_objections(folder / name, stamp, stamp_of)
    for name, path in inputs.entries.items():
        try:
            read_manifest(Path(path))
        except ValueError as error:
            yield NotDone("store", f"the result of its stage {name} in the store is damaged or gone ({error})")


def _file_objections(path: Path, stamp: Stamp, stamp_now: Callable[[Path], Stamp]) -> Iterator[NotDone]:
    try:
        if stamp_now(path) != stamp:
            yield NotDone("file", f"{path} has changed")
    except (OSError, ValueError) as error:
        yield NotDone("file", f"{path} cannot be read ({getattr(error, 'strerror', error)})")


def _lacking(
    results: TrialRecord,
    unavailable_now: Callable[[dict[str, Any]], Collection[str]],
    options: dict[str, Any],
) -> NotDone | None:
    """The metrics that a trial lacks and that could be computed now."""
    lacking = set(results.awaited)  # those that may still come, once their weights or packages are there
    if missing := sorted(lacking - set(unavailable_now(options))) if lacking else []:
        return NotDone("metric", f"it lacks {', '.join(missing)}, which may be computed now")
    return None


def _changed(folder: Path) -> int | None:
    try:
        return folder.stat().st_mtime_ns
    except (OSError, ValueError):
        return None
