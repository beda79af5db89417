"""``inputs.json``: what a finished trial's results were made of, and how its files were when they were written."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pydantic_core import from_json

from gsbench.files import file_sha256, write_json, write_text
from gsbench.parsing import DamagedError, fault_of, read_bytes
from gsbench.records import Part, read_typed
from gsbench.runs.hashing import config_hash, sha256_of
from gsbench.runs.layout import CURVES, EVENTS, HISTOGRAMS, INPUTS, PER_VIEW, RESULTS
from gsbench.runs.stages import STAGES
from gsbench.runs.trial_record import TrialRecord, record_from, results_text

INPUTS_VERSION = 2
PYCOLMAP = "pycolmap"  # the package whose version has a part in every cloud
READ_LATER = (PER_VIEW, CURVES, EVENTS, HISTOGRAMS)  # beside the results, by tables and reports

Stamp = tuple[int, ...]  # size in bytes, times of change in ns


@dataclass(frozen=True, kw_only=True)
class Promise(Part):
    """Required state of the files that tables and reports read: the hash of the results as canonical JSON, and the
    sha256 of files by name.
    """

    version: int
    results: str
    digests: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Inputs(Promise):
    """All of the record: configuration's hash, versions, and files with their stamps; ``entries`` are folders in the
    store, ``published`` files in the trial's folder."""

    config: str
    stages: dict[str, int]
    pycolmap: str | None
    sources: dict[str, Stamp]
    folders: dict[str, int | None]
    entries: dict[str, str]
    published: dict[str, Stamp]


@dataclass(frozen=True, kw_only=True)
class Settings(Part):
    """The configuration that the results were made by, which is quicker to read here than as YAML."""

    settings: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        if fault := fault_of(self.settings):
            raise ValueError(f"in settings {fault}")


def write_finished(
    folder: Path,
    values: Mapping[str, Any],
    record: TrialRecord,
    sources: Iterable[Path] = (),
    entries: Mapping[str, Path] | None = None,
    published: Iterable[Path] = (),
) -> bool:
    """Write ``inputs.json``, then ``results.json``, after which the trial in ``folder`` is complete.

    ``sources`` are the user's files, ``entries`` results of stages by name, ``published`` the files that the folder
    shows. True where equal results stood there already: they are left as they are, with their time.
    """
    text = results_text(record)
    standing = _standing(folder) == record.to_json()
    digests = {name: file_sha256(folder / name) for name in READ_LATER if (folder / name).is_file()}
    digests[RESULTS] = file_sha256(folder / RESULTS) if standing else hashlib.sha256(text.encode()).hexdigest()
    sources = sorted(sources)
    places = sorted({path.parent for path in sources})  # their time of change tells of files that came or went
    inputs = {
        "version": INPUTS_VERSION,
        "config": config_hash(dict(values)),
        "results": sha256_of(record.to_json()),
        "digests": digests,
        "stages": {stage.name: stage.version for stage in STAGES},
        "pycolmap": version_of(PYCOLMAP),
        "sources": {str(path): source_stamp_of(path) for path in sources},
        "folders": {str(path): path.stat().st_mtime_ns for path in places},
        "entries": {name: str(path) for name, path in (entries or {}).items()},
        "published": {path.relative_to(folder).as_posix(): stamp_of(path) for path in published},
        "settings": values,
    }
    write_json(folder / INPUTS, inputs)
    if not standing:
        write_text(folder / RESULTS, text)
    return standing


def _standing(folder: Path) -> dict[str, Any] | None:
    try:
        return record_from(read_bytes(folder / RESULTS), folder / RESULTS).to_json()
    except (FileNotFoundError, DamagedError):
        return None


def read_results(folder: Path) -> tuple[TrialRecord, Mapping[str, str]]:
    """The results of the trial in ``folder``, and the sha256 of the other files to be read, where it is known.

    Raises FileNotFoundError where there are none, and DamagedError where they are damaged, unfinished, or not as they
    were written. What has no ``inputs.json`` cannot be checked, and is believed.
    """
    path = folder / RESULTS
    content = read_bytes(path)
    record = record_from(content, path)
    try:
        promise = read_typed(folder / INPUTS, Promise)
    except FileNotFoundError:
        return record, {}
    same_bytes = hashlib.sha256(content).hexdigest() == promise.digests.get(RESULTS)
    if not same_bytes and sha256_of(from_json(content)) != promise.results:  # other spaces are no other results
        raise DamagedError(
            path, f"is not as it was written ({INPUTS}): `gsbench retry {folder.parents[2].name}` mends it"
        )
    return record, promise.digests


def sound_results(folder: Path) -> TrialRecord | None:
    """The results of the trial in ``folder``; None where it has none that can be relied on."""
    try:
        return read_results(folder)[0]
    except (FileNotFoundError, DamagedError):
        return None


def read_inputs(folder: Path) -> Inputs:
    """The record of the trial in ``folder``; raises FileNotFoundError and DamagedError."""
    return read_typed(folder / INPUTS, Inputs)


def read_settings(folder: Path) -> dict[str, Any] | None:
    """The configuration in the trial's ``inputs.json``; None where it is not there. Raises DamagedError."""
    try:
        return read_typed(folder / INPUTS, Settings).settings
    except FileNotFoundError:
        return None


def read_unchanged(path: Path, digests: Mapping[str, str]) -> bytes:
    """The content of a file of a trial; raises as `read_bytes`, and DamagedError where it is not as it was written."""
    content = read_bytes(path)
    wanted = digests.get(path.name)
    if wanted is not None and hashlib.sha256(content).hexdigest() != wanted:
        raise DamagedError(path, f"is not as it was written ({INPUTS}): delete it, and `gsbench retry` mends the trial")
    return content


def stamp_of(path: Path) -> Stamp:
    """Size and time of change; raises OSError."""
    state = os.stat(path)
    return state.st_size, state.st_mtime_ns


def source_stamp_of(path: Path) -> Stamp:
    """Size and time of change, and when the system saw a change, which nobody can set back; raises OSError.

    For what is the user's, which a program may have replaced and given the time of before. Our own files are links,
    whose state changes with each further one.
    """
    state = os.stat(path)
    return state.st_size, state.st_mtime_ns, state.st_ctime_ns


def version_of(package: str) -> str | None:
    """The version of an installed package; None where there is none."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
