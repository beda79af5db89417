"""The recorded inputs of a finished trial (``made_of`` in ``results.json``), and what has changed since.

By these a repeated sweep recognises finished trials without reading photographs. Loads no torch.
"""

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pydantic_core import from_json

from gsbench.files import file_sha256
from gsbench.parsing import DamagedError, fault_of, read_bytes
from gsbench.records import Record
from gsbench.runs.code import changed_rooms
from gsbench.runs.keys import STAGES, config_hash, sha256_of
from gsbench.runs.layout import CURVES, EVENTS, HISTOGRAMS, PER_VIEW
from gsbench.runs.store import read_manifest
from gsbench.runs.trial_record import TrialRecord

MADE_OF = "made_of"  # the key in results.json
READ_LATER = (PER_VIEW, CURVES, EVENTS, HISTOGRAMS)  # files that tables and reports read
PYCOLMAP = "pycolmap"  # the package whose version affects every initial cloud
# Files up to so many bytes are compared by content, since a flipped bit changes neither size nor time.
MAX_HASHED_BYTES = 1 << 20

Stamp = tuple[int, ...]  # size in bytes, times of change in ns

_digests: dict[Stamp, str] = {}  # sha256 of files that this process has read, by device, inode and stamp


@dataclass(frozen=True, kw_only=True)
class MadeOf(Record):
    """The configuration (``settings``) and its hash (``config``), versions, and files with their stamps.

    ``results`` is the hash of the rest of ``results.json``. ``sources`` are the user's files, ``folders`` their folders
    with times of change. ``entries`` are the stages' results in the store. ``published`` are files in the trial's
    folder; ``digests`` has the sha256 of those that tables and reports read, and of small ones.
    """

    results: str
    config: str
    stages: dict[str, int]
    pycolmap: str | None
    sources: dict[str, Stamp]
    folders: dict[str, int | None]
    entries: dict[str, str]
    published: dict[str, Stamp]
    digests: dict[str, str]
    settings: dict[str, Any]

    def __post_init__(self) -> None:
        if fault := fault_of(self.settings):
            raise ValueError(f"in settings {fault}")


@dataclass(frozen=True, kw_only=True)
class ResultsFile(Record):
    """The part of ``results.json`` that this module reads."""

    made_of: MadeOf | None = field(default=None, repr=False)


def describe_inputs(
    folder: Path,
    values: Mapping[str, Any],
    content: Mapping[str, Any],
    sources: Iterable[Path],
    entries: Mapping[str, Path],
    published: Iterable[Path],
) -> MadeOf:
    """The inputs of the results ``content`` of the trial in ``folder``, with the present state of files.

    ``sources`` are the user's files, ``entries`` results of stages by name, ``published`` files in the trial's folder.
    """
    sources = sorted(sources)
    names = {path.relative_to(folder).as_posix(): path for path in published}
    return MadeOf(
        results=sha256_of(content),
        config=config_hash(dict(values)),
        stages={stage.name: stage.version for stage in STAGES},
        pycolmap=version_of(PYCOLMAP),
        sources={str(path): source_stamp_of(path) for path in sources},
        # Adding or removing a file changes its folder's time.
        folders={str(path): path.stat().st_mtime_ns for path in sorted({path.parent for path in sources})},
        entries={name: str(path) for name, path in entries.items()},
        published={name: stamp_of(path) for name, path in names.items()},
        digests={name: file_sha256(path) for name, path in names.items() if _is_hashed(name, path)},
        settings=dict(values),
    )


def find_changes(folder: Path, values: dict[str, Any], record: TrialRecord, made_of: MadeOf) -> Iterator[str]:
    """Reasons why the complete trial in ``folder`` is out of date; those that are found quickly come first.

    Files are compared by size and time of change, small files of gsbench's also by content.
    """
    present = config_hash(values)
    if record.hashes.get("config") != present or made_of.config != present:
        yield "its results are of another configuration"
    versions = {stage.name: stage.version for stage in STAGES}
    for name in sorted(versions.keys() | made_of.stages.keys()):
        made, now = made_of.stages.get(name), versions.get(name)
        if made != now:
            yield f"it was made by version {made} of the stage {name}, which is now at {now}"
    if rooms := changed_rooms(record.code.rooms):
        yield f"the code of gsbench changed in: {', '.join(rooms)}"
    if made_of.pycolmap != (installed := version_of(PYCOLMAP)):
        yield f"it was made with {PYCOLMAP} {made_of.pycolmap}, and {installed} is installed"
    for source, stamp in made_of.sources.items():
        yield from _change_of(Path(source), stamp, source_stamp_of)
    for source_folder, changed in made_of.folders.items():
        if _changed_at(Path(source_folder)) != changed:
            yield f"files have come to {source_folder}, or gone from there"
    for name, stamp in made_of.published.items():
        yield from _change_of(folder / name, stamp, stamp_of)
        if name in made_of.digests and _digest(folder / name) != made_of.digests[name]:
            yield f"{folder / name} has changed"
    for name, entry in made_of.entries.items():
        try:
            read_manifest(Path(entry))
        except ValueError as error:
            yield f"the result of its stage {name} in the store is damaged or gone ({error})"


def content_hash(content: bytes) -> str:
    """The hash of the values in ``results.json`` without ``made_of``; white space does not matter."""
    values = from_json(content)
    values.pop(MADE_OF, None)
    return sha256_of(values)


def stamp_of(path: Path) -> Stamp:
    """Size and time of change; raises OSError."""
    state = os.stat(path)
    return state.st_size, state.st_mtime_ns


def source_stamp_of(path: Path) -> Stamp:
    """Size, mtime and ctime of a user's file; raises OSError.

    A program may replace a file and restore its mtime, but not its ctime. The ctime of gsbench's own files is not used:
    they are hard links, and each further link changes it.
    """
    state = os.stat(path)
    return state.st_size, state.st_mtime_ns, state.st_ctime_ns


def version_of(package: str) -> str | None:
    """The version of an installed package; None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _change_of(path: Path, stamp: Stamp, stamp_now: Callable[[Path], Stamp]) -> Iterator[str]:
    try:
        if stamp_now(path) != stamp:
            yield f"{path} has changed"
    except (OSError, ValueError) as error:
        yield f"{path} cannot be read ({getattr(error, 'strerror', error)})"


def _changed_at(folder: Path) -> int | None:
    try:
        return folder.stat().st_mtime_ns
    except (OSError, ValueError):
        return None


def _is_hashed(name: str, path: Path) -> bool:
    return name in READ_LATER or path.stat().st_size <= MAX_HASHED_BYTES


def _digest(path: Path) -> str | None:
    """The sha256 of a file's content; None if it cannot be read.

    Trials share photographs as hard links to one file, so its content is read once.
    """
    try:
        state = os.stat(path)
        key = state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns
        if key not in _digests:
            _digests[key] = hashlib.sha256(read_bytes(path)).hexdigest()
        return _digests[key]
    except (OSError, DamagedError):
        return None
