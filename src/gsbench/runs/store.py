"""A store of stage results by the key of their inputs, so that nothing is computed twice.

``<root>/<stage>/<key>/`` is a finished result; its ``manifest.json`` is written last. A result is
built in ``.<key>.partial/``, which a killed build leaves behind. While one process builds, it holds
``.<key>.lock`` (an empty file that is never removed), and others wait.
"""

import logging
import os
import re
import shutil
import stat
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsbench import __version__
from gsbench.errors import InputError
from gsbench.files import (
    file_sha256,
    remove_special_files,
    remove_temporaries,
    require_no_links,
    storage_errors,
    sync_to_disk,
    write_json,
)
from gsbench.parsing import (
    Amount,
    Count,
    DamagedError,
    Raw,
    Record,
    fault_of,
    read_bytes,
    read_typed,
)
from gsbench.runs.experiments import stamp_now
from gsbench.runs.keys import Stage, Step
from gsbench.runs.layout import BUILDING, MANIFEST, RESULTS, STORE
from gsbench.system.locks import BusyError, hold

log = logging.getLogger(__name__)

KEY = re.compile("[0-9a-f]+")


class Output(Record):
    """A file of a result as it was written."""

    size: Count
    mtime_ns: int
    sha256: str


class Manifest(Record):
    """``manifest.json`` of a finished result: its inputs, and a checksum of every file."""

    stage: str
    version: int
    key: str
    inputs: dict[str, Any]
    outputs: dict[Raw, Output]
    seconds: Amount
    gsbench: str
    created: str

    def __post_init__(self) -> None:
        if fault := fault_of(self.inputs):
            raise ValueError(f"in inputs {fault}")


@dataclass(frozen=True)
class StoredResult:
    """A finished result in the store.

    ``cached`` says that it was not built now. ``seconds`` is the time that building it took.
    """

    path: Path
    key: str
    seconds: float
    cached: bool


class Store:
    """The store below ``root``; ``on_build`` gets each stage that is built, and its folder."""

    def __init__(
        self, root: Path, on_build: Callable[[Stage, Path], None] = lambda stage, folder: None
    ) -> None:
        self.root, self.on_build = root, on_build
        # results whose checksums this process has compared or computed
        self._verified: set[Path] = set()

    def folder(self, stage: Stage, key: str) -> Path:
        """The folder of the finished result of ``stage`` under ``key``."""
        return self.root / stage.name / key

    def existing(self, stage: Stage, key: str) -> Path:
        """The folder of the finished result of ``stage`` under ``key``, all of it compared.

        Raises InputError if there is none, or if it is not as it was written.
        """
        folder = self.folder(stage, key)
        if not KEY.fullmatch(key) or not folder.is_dir():
            raise InputError(f"{folder} is gone: run this trial again")
        require_no_links(self.root.parent, folder, below=True)
        try:
            read_manifest(folder, thorough=True)
        except ValueError as error:
            raise InputError(f"{folder} is damaged ({error}): run this trial again") from None
        return folder

    def path(self, step: Step) -> Path:
        """The folder of the result of ``step`` once it is finished."""
        return self.folder(step.stage, step.key)

    def partial(self, stage: Stage, key: str) -> Path:
        """The folder in which the result of ``stage`` under ``key`` is built."""
        return self.root / stage.name / f".{key}.partial"

    def find(self, step: Step) -> StoredResult | None:
        """The result of ``step`` if it is finished and sound, else None."""
        try:
            return self._read(self.path(step), thorough=False)
        except ValueError:
            return None

    def get(self, step: Step) -> StoredResult:
        """The result of ``step``; it is built unless it exists, and published by an atomic rename.

        A damaged result is built again, with a warning. Raises DiskFullError if the disk is
        full, and InputError if the store is read-only.
        """
        final = self.path(step)
        with suppress(ValueError):
            found = self._read(final, thorough=True)
            log.debug("store: %s %s is there", step.stage.name, step.key[:8])
            return found
        with storage_errors(self.root.parent):
            require_no_links(self.root.parent, self.partial(step.stage, step.key))
            final.parent.mkdir(parents=True, exist_ok=True)
            with hold(final.parent / f".{step.key}.lock", f"{step.stage.name} {step.key[:8]}"):
                # another process may have built it while this one waited
                if os.path.lexists(final):
                    try:
                        return self._read(final, thorough=True)
                    except ValueError as error:
                        log.warning("store: %s is damaged (%s) and is built again", final, error)
                        remove(final)
                log.debug("store: %s %s is computed", step.stage.name, step.key[:8])
                return self._build(step)

    def _read(self, path: Path, thorough: bool) -> StoredResult:
        """The result in ``path``; ``thorough`` compares checksums once in each process.

        An existing result may become the input of further steps, and a flipped bit changes neither
        size nor time of change.
        """
        if path.is_symlink():
            raise ValueError("it is a link")
        manifest = read_manifest(path, thorough=thorough and path not in self._verified)
        if thorough:
            self._verified.add(path)
        return StoredResult(path, path.name, manifest.seconds, cached=True)

    def _build(self, step: Step) -> StoredResult:
        """Build or finish the partial folder, and publish it.

        The caller holds the lock of the step's key.
        """
        final, partial, stage = self.path(step), self.partial(step.stage, step.key), step.stage
        seconds = None
        # A sound manifest here: an earlier build was killed after writing it, before publishing.
        with suppress(ValueError):
            seconds = read_manifest(partial, step.key).seconds
        if seconds is None:
            if partial.exists() and not stage.resumable:
                remove(partial)
            partial.mkdir(exist_ok=True)
            remove_temporaries(partial)
            remove_special_files(partial)
            (partial / MANIFEST).unlink(missing_ok=True)
            self.on_build(stage, partial)
            started = time.perf_counter()
            step.build(partial)
            step.check()
            seconds = time.perf_counter() - started
            write_manifest(partial, step, seconds)
        for pattern in stage.scratch:
            for path in partial.rglob(pattern):
                path.unlink()
        os.replace(partial, final)
        sync_to_disk(final.parent)
        self._verified.add(final)
        return StoredResult(final, step.key, seconds, cached=False)

    def sweep(self, stages: Iterable[Stage]) -> None:
        """Remove the remains of killed processes that no build would continue.

        Locked folders are left alone.
        """
        for stage in stages:
            for partial in (self.root / stage.name).glob(".*.partial"):
                key = _key_of(partial)
                if not stage.resumable or self.folder(stage, key).exists():
                    lock = partial.with_name(f".{key}.lock")
                    with suppress(BusyError), suppress(OSError), hold(lock, key, wait=False):
                        remove(partial)
            for removed in (self.root / stage.name).glob(".*.removed"):
                shutil.rmtree(removed, ignore_errors=True)


def write_manifest(folder: Path, step: Step, seconds: float) -> None:
    """Write the manifest of ``folder``: checksums of all files, once these are safe on the disk."""
    scratch = set[Path]().union(*map(folder.rglob, step.stage.scratch))
    outputs = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path not in scratch:
            sync_to_disk(path)
            state = path.stat()
            outputs[path.relative_to(folder).as_posix()] = {
                "size": state.st_size,
                "mtime_ns": state.st_mtime_ns,
                "sha256": file_sha256(path),
            }
    manifest = {
        "stage": step.stage.name,
        "version": step.stage.version,
        "key": step.key,
        "inputs": step.inputs,
        "outputs": outputs,
        "seconds": seconds,
        "gsbench": __version__,
        "created": stamp_now(),
    }
    write_json(folder / MANIFEST, manifest)


def read_manifest(folder: Path, key: str | None = None, thorough: bool = False) -> Manifest:
    """Read and check the manifest in ``folder``; ``key`` defaults to the folder's name.

    A file with the recorded size and time of change counts as sound, unless ``thorough``; other
    files are compared by checksum. Raises ValueError that names what is damaged.
    """
    try:
        manifest = read_typed(folder / MANIFEST, Manifest)
    except (FileNotFoundError, DamagedError) as error:
        raise ValueError(f"{MANIFEST} is missing or unreadable") from error
    if manifest.key != (key or folder.name):
        raise ValueError(f"{MANIFEST} belongs to another key")
    if manifest.key != Stage(manifest.stage, manifest.version).key(manifest.inputs):
        raise ValueError(f"{MANIFEST} does not match its key")
    for name, recorded in manifest.outputs.items():
        if not is_sound(folder, name, recorded, thorough):
            raise ValueError(f"{name} differs from what was written")
    return manifest


def is_sound(folder: Path, name: str, recorded: Output, thorough: bool) -> bool:
    """Return whether a file is as it was recorded; see `read_manifest`."""
    path = folder / name
    try:
        require_no_links(folder, path)
        state = path.stat()
        if not stat.S_ISREG(state.st_mode) or state.st_size != recorded.size:
            return False
        if not thorough and state.st_mtime_ns == recorded.mtime_ns:
            return True
        return file_sha256(path) == recorded.sha256
    except (OSError, ValueError, InputError):  # ValueError: a NUL in the name, or another folder
        return False


def remove(folder: Path) -> None:
    """Remove a folder.

    It is renamed first, so that a kill in between leaves nothing that looks like a result.
    """
    removed = folder.with_name(f".{folder.name.lstrip('.')}.removed")
    shutil.rmtree(removed, ignore_errors=True)
    os.replace(folder, removed)
    shutil.rmtree(removed, ignore_errors=True)


# ---- content of the store, references of trials to it, and removal of the rest (`gsbench clean`)

# A trial's ``results.json`` and ``building.json`` name the keys of its results in the store, and
# their manifests the keys of what they were made from. Keys are looked for as text, so that a
# damaged record still protects what it names.
KEY_IN_TEXT = re.compile(rb"(?<![0-9a-f])[0-9a-f]{64}(?![0-9a-f])")
FOLDER = re.compile(r"\.?[0-9a-f]+(\.partial)?")


@dataclass(frozen=True)
class Stored:
    """A folder in the store, finished or not.

    ``size`` are its bytes, ``own`` those of files that no trial's folder shares by a hard link:
    removing the folder frees them. ``age`` is in seconds. ``needed`` says that a trial refers to
    it.
    """

    path: Path
    size: int
    own: int
    age: float
    needed: bool

    @property
    def stage(self) -> str:
        return self.path.parent.name


def stored(runs: Path, trials: Iterable[Path]) -> list[Stored]:
    """All folders in the store of ``runs``; those that the folders ``trials`` need are marked.

    Raises InputError for a link in place of the store.
    """
    places = list(_folders(runs))
    keys = {place: _key_of(place) for place in places}
    by_key: dict[str, list[Path]] = {}
    for place, key in keys.items():
        by_key.setdefault(key, []).append(place)
    wanted = set[str]()
    new = {key for trial in trials for key in _keys_in(trial / RESULTS, trial / BUILDING)}
    while new := (new & by_key.keys()) - wanted:
        wanted |= new
        new = {key for name in new for place in by_key[name] for key in _keys_in(place / MANIFEST)}
    now = time.time()
    return [_measured(place, now, keys[place] in wanted) for place in places]


def _folders(runs: Path) -> Iterator[Path]:
    store = runs / STORE
    require_no_links(runs, store)
    for stage in sorted(store.iterdir()) if store.is_dir() else ():
        if stage.is_dir() and not stage.is_symlink():
            for place in sorted(stage.iterdir()):
                if place.is_dir() and not place.is_symlink() and FOLDER.fullmatch(place.name):
                    yield place


def _key_of(place: Path) -> str:
    return place.name.removeprefix(".").removesuffix(".partial")


def _keys_in(*files: Path) -> set[str]:
    found = set[str]()
    for file in files:
        with suppress(FileNotFoundError, DamagedError):
            found |= {key.decode() for key in KEY_IN_TEXT.findall(read_bytes(file))}
    return found


def _measured(place: Path, now: float, needed: bool) -> Stored:
    """Sizes and age of a folder; its age is that of its newest file."""
    states = [place.lstat()]
    for path in place.rglob("*"):
        with suppress(FileNotFoundError):
            states.append(path.lstat())
    files = states[1:]
    own = sum(state.st_size for state in files if state.st_nlink == 1)
    newest = max(state.st_mtime for state in states)
    return Stored(place, sum(state.st_size for state in files), own, now - newest, needed)


def free(runs: Path, places: Collection[Stored]) -> list[Stored]:
    """Remove folders of the store; returns those that were removed, without those being built.

    Raises InputError if a folder is a link.
    """
    removed = []
    for one in places:
        if one.needed:
            raise InputError(f"{one.path} is needed by a finished trial: it stays")
        require_no_links(runs, one.path)
        lock = one.path.with_name(f".{_key_of(one.path)}.lock")
        with suppress(BusyError), hold(lock, one.path.name, wait=False):
            remove(one.path)
            removed.append(one)
    return removed
