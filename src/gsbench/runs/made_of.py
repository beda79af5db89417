"""The inputs of a finished trial's results, as ``results.json`` says them, and whether they still hold.

A sweep that is given again recognises what is done by this, without reading photographs. Loads no torch.
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
READ_LATER = (PER_VIEW, CURVES, EVENTS, HISTOGRAMS)  # beside the results, by tables and reports
PYCOLMAP = "pycolmap"  # the package whose version has a part in every cloud
MOST_HASHED = 1 << 20  # bytes of a file whose content is compared as well, since a flipped bit keeps size and time

Stamp = tuple[int, ...]  # size in bytes, times of change in ns

_digests: dict[Stamp, str] = {}  # by a file's device, number and state: what this process has read


@dataclass(frozen=True, kw_only=True)
class MadeOf(Record):
    """The configuration with its hash, versions, and files with their stamps.

    ``results`` is the hash of the rest of ``results.json``, ``sources`` are files of the user's and ``folders`` where
    they lie, ``entries`` folders in the store, ``published`` files in the trial's folder, of which ``digests`` has the
    sha256 of those that tables and reports read, and of small ones.
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
class OnDisk(Record):
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
    """The record of what the results ``content`` of the trial in ``folder`` were made of; files are as they are now.

    ``sources`` are the user's files, ``entries`` results of stages by name, ``published`` the files that the folder
    shows.
    """
    sources = sorted(sources)
    names = {path.relative_to(folder).as_posix(): path for path in published}
    return MadeOf(
        results=sha256_of(content),
        config=config_hash(dict(values)),
        stages={stage.name: stage.version for stage in STAGES},
        pycolmap=version_of(PYCOLMAP),
        sources={str(path): source_stamp_of(path) for path in sources},
        # A folder's time of change tells of files that came or went.
        folders={str(path): path.stat().st_mtime_ns for path in sorted({path.parent for path in sources})},
        entries={name: str(path) for name, path in entries.items()},
        published={name: stamp_of(path) for name, path in names.items()},
        digests={name: file_sha256(path) for name, path in names.items() if _is_hashed(name, path)},
        settings=dict(values),
    )


def changes(folder: Path, values: dict[str, Any], record: TrialRecord, made_of: MadeOf) -> Iterator[str]:
    """Reasons why the complete trial in ``folder`` no longer holds, the quickest to find first.

    Files are compared by size and time of change, small ones that gsbench wrote also by their content.
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
    for place, stamp in made_of.sources.items():
        yield from _change_of(Path(place), stamp, source_stamp_of)
    for place, changed in made_of.folders.items():
        if _changed_at(Path(place)) != changed:
            yield f"files have come to {place}, or gone from there"
    for name, stamp in made_of.published.items():
        yield from _change_of(folder / name, stamp, stamp_of)
        if name in made_of.digests and _digest(folder / name) != made_of.digests[name]:
            yield f"{folder / name} has changed"
    for name, place in made_of.entries.items():
        try:
            read_manifest(Path(place))
        except ValueError as error:
            yield f"the result of its stage {name} in the store is damaged or gone ({error})"


def content_hash(content: bytes) -> str:
    """The hash of what ``results.json`` says but for what it was made of, whatever its spaces."""
    whole = from_json(content)
    whole.pop(MADE_OF, None)
    return sha256_of(whole)


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
    return name in READ_LATER or path.stat().st_size <= MOST_HASHED


def _digest(path: Path) -> str | None:
    """The sha256 of a file's content; None where it cannot be read.

    Trials share photographs as links to one file, whose content is read once.
    """
    try:
        state = os.stat(path)
        key = state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns
        if key not in _digests:
            _digests[key] = hashlib.sha256(read_bytes(path)).hexdigest()
        return _digests[key]
    except (OSError, DamagedError):
        return None
