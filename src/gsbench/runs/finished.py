"""Whether a trial's results still hold: what they were made of is written down, and compared later. Loads no torch."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

from gsbench.files import read_object, write_json
from gsbench.runs.code import changed_files
from gsbench.runs.hashing import config_hash, sha256_of
from gsbench.runs.layout import INPUTS, RESULTS
from gsbench.runs.stages import STAGES
from gsbench.runs.store import read_manifest
from gsbench.runs.trial_files import TrialPaths

INPUTS_VERSION = 2
PYCOLMAP = "pycolmap"  # the package whose version has a part in every cloud

Cause = Literal["unfinished", "configuration", "record", "stage", "package", "file", "store", "metric", "code"]


@dataclass(frozen=True)
class Done:
    """A trial is done, and nothing that it was made of has changed; ``results`` is what ``results.json`` holds."""

    results: dict[str, Any]


@dataclass(frozen=True)
class NotDone:
    """A trial has to be run or checked; ``reason`` says in words which file, stage, package or metric is the cause."""

    cause: Cause
    reason: str


def record_inputs(
    folder: Path,
    values: dict[str, Any],
    results: dict[str, Any],
    sources: Iterable[Path],
    entries: Mapping[str, Path],
    published: Iterable[Path],
) -> None:
    """Write down what `find_finished` needs: source files, stage results by name, files shown in ``folder``."""
    sources = list(sources)
    folders = sorted({path.parent for path in sources})  # their time of change tells of files that came or went
    record = {
        "version": INPUTS_VERSION,
        "config": config_hash(values),
        "results": sha256_of(results),
        "stages": {stage.name: stage.version for stage in STAGES},
        "pycolmap": _version(PYCOLMAP),
        "sources": {str(path): _stamp(path) for path in sorted(sources)},
        "folders": {str(path): path.stat().st_mtime_ns for path in folders},
        "entries": {name: str(path) for name, path in entries.items()},
        "published": {path.relative_to(folder).as_posix(): _stamp(path) for path in published},
    }
    write_json(folder / INPUTS, record)


def find_finished(
    values: dict[str, Any], unavailable_now: Callable[[dict[str, Any]], Collection[str]] = lambda options: ()
) -> Done | NotDone:
    """Whether the trial with the resolved configuration ``values`` is done and nothing that it was made of has changed.

    Quick, since files are compared by size and time of change. A trial that lacks a metric for want of weights is done
    only if ``unavailable_now``, called with the ``eval`` settings, says that it would lack it again.
    """
    folder = TrialPaths.of(values).folder
    results, record = read_object(folder / RESULTS), read_object(folder / INPUTS)
    if results.get("status") != "complete":
        return NotDone("unfinished", f"{RESULTS} is not there, or not complete")
    if not record:
        return NotDone("record", f"{INPUTS} is not there, or damaged")
    try:
        objections = _objections(folder, values, results, record)
        return next(objections, None) or _lacking(results, unavailable_now, values["eval"]) or Done(results)
    except (KeyError, TypeError, AttributeError, ValueError):
        return NotDone("record", f"{RESULTS} or {INPUTS} lacks what a finished trial has")


def _objections(
    folder: Path, values: dict[str, Any], results: Mapping[str, Any], record: Mapping[str, Any]
) -> Iterator[NotDone]:
    """What of a complete trial no longer holds, the quickest to find first."""
    present = config_hash(values)
    if results["hashes"]["config"] != present or record["config"] != present:
        yield NotDone("configuration", "its results are of another configuration")
    if record["version"] != INPUTS_VERSION:
        yield NotDone("record", f"{INPUTS} was written by another version of gsbench")
    if record["results"] != sha256_of(results):
        yield NotDone("record", f"{RESULTS} is not as it was written")
    versions = {stage.name: stage.version for stage in STAGES}
    for name in sorted(versions.keys() | record["stages"].keys()):
        made, now = record["stages"].get(name), versions.get(name)
        if made != now:
            yield NotDone("stage", f"it was made by version {made} of the stage {name}, which is now at {now}")
    if files := changed_files(results.get("code", {}).get("files", {})):
        yield NotDone("code", f"the code of gsbench changed in: {', '.join(files)}")
    if record["pycolmap"] != (installed := _version(PYCOLMAP)):
        yield NotDone("package", f"it was made with {PYCOLMAP} {record['pycolmap']}, and {installed} is installed")
    for path, stamp in record["sources"].items():
        yield from _file_objections(Path(path), stamp)
    for path, changed in record["folders"].items():
        if _changed(Path(path)) != changed:
            yield NotDone("file", f"files have come to {path}, or gone from there")
    for name, stamp in record["published"].items():
        yield from _file_objections(folder / name, stamp)
    for name, path in record["entries"].items():
        try:
            read_manifest(Path(path))
        except ValueError as error:
            yield NotDone("store", f"the result of its stage {name} in the store is damaged or gone ({error})")


def _file_objections(path: Path, stamp: list[int]) -> Iterator[NotDone]:
    try:
        if _stamp(path) != stamp:
            yield NotDone("file", f"{path} has changed")
    except OSError as error:
        yield NotDone("file", f"{path} cannot be read ({error.strerror})")


def _lacking(
    results: Mapping[str, Any],
    unavailable_now: Callable[[dict[str, Any]], Collection[str]],
    options: dict[str, Any],
) -> NotDone | None:
    """The metrics that a trial lacks and that could be computed now."""
    lacking = set(results["awaited"])  # those that may still come, once their weights or packages are there
    if missing := sorted(lacking - set(unavailable_now(options))) if lacking else []:
        return NotDone("metric", f"it lacks {', '.join(missing)}, which may be computed now")
    return None


def _stamp(path: Path) -> list[int]:
    state = os.stat(path)
    return [state.st_size, state.st_mtime_ns]


def _changed(folder: Path) -> int | None:
    try:
        return folder.stat().st_mtime_ns
    except OSError:
        return None


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
