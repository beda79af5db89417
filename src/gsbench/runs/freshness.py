"""The origin of a result, and whether it still holds: one rule for runs, dry run, status, tables.

A result holds if all that made it is the same now: settings and user's code, gsbench's code,
pycolmap, the user's files, the trial's own files, and the stages' results in the store. Each
difference is a `Change`. Results may be read where they were not made, so whoever reads compares
only their code, and says with what (`code_changes`).
"""

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from gsbench.files import file_sha256
from gsbench.parsing import Amount, DamagedError, Raw, Record, read_bytes
from gsbench.runs import layout
from gsbench.runs.code import config_hash, state_of
from gsbench.runs.configuration import Values, sha256_of
from gsbench.runs.keys import STAGES
from gsbench.runs.store import read_manifest
from gsbench.runs.trial_record import Code, TrialRecord
from gsbench.system.install import version_of
from gsbench.words import as_line

Stamp = tuple[int, ...]  # size in bytes, times of change in ns


class MadeOf(Record):
    """The inputs of a trial's results: configuration, versions, and files with their stamps.

    ``settings`` is the configuration, ``config`` its hash, ``results`` the hash of the rest of
    ``results.json``. ``sources`` are the user's files, ``folders`` their folders with times of
    change. ``entries`` are the stages' results in the store. ``published`` are files in the
    trial's folder; ``digests`` has the sha256 of those that tables and reports read, and of
    small ones. ``finished`` is the Unix time at which the trial first had these results; 0 if
    unknown.
    """

    results: str
    config: str
    stages: dict[str, int]
    pycolmap: str | None
    sources: dict[Raw, Stamp]
    folders: dict[Raw, int | None]
    entries: dict[str, Raw]
    published: dict[Raw, Stamp]
    digests: dict[Raw, str]
    settings: dict[str, Any]
    finished: Amount = 0.0


class ResultsFile(Record):
    """The part of ``results.json`` that says what the results were made of."""

    made_of: MadeOf | None = field(default=None, repr=False)


SENTENCES = {
    "unfinished": "{name} is not there, or not complete",
    "damaged": "{name} {now}",
    "unrecorded": "{name} does not say what it was made of",
    "settings": "its results are of another configuration",
    "code": "{name} was {made:.8}, it is now {now:.8}",
    "file": "{name} has changed",
    "unreadable": "{name} cannot be read ({now})",
    "written": f"{{name}} was changed after {layout.RESULTS} was written",
    "folder": "files were added to {name}, or removed",
    "stored": "the result of its stage {name} in the store is damaged or gone ({now})",
    "lacking": "it lacks {name}",
    "computable": "it lacks {name}, which can be computed now",
}


@dataclass(frozen=True)
class Change:
    """A thing that made a result and is another one now; ``kind`` is one of `SENTENCES`."""

    kind: str
    name: str
    made: str = ""
    now: str = ""

    def __str__(self) -> str:
        facts = {"name": self.name, "made": self.made, "now": self.now}
        return as_line(SENTENCES[self.kind].format(**facts))


# ---- code


@dataclass(frozen=True, order=True)
class Part:
    """A part of the code: a user's module, a stage of gsbench, or one of its packages."""

    kind: Literal["module", "stage", "package"]
    name: str

    def __str__(self) -> str:
        before = {"module": "code of ", "stage": "stage ", "package": "gsbench's "}
        return f"{before[self.kind]}{self.name}"

    @property
    def short(self) -> str:
        """The text without "code of"."""
        return self.name if self.kind == "module" else str(self)


def code_of(code: Code) -> dict[Part, str]:
    """The versions of all parts of the code that made a trial."""
    return (
        {Part("module", name): digest for name, digest in code.sources.items()}
        | {Part("stage", name): str(version) for name, version in code.stages.items()}
        | {Part("package", name): state for name, state in code.packages.items()}
    )


def present_version(part: Part) -> str | None:
    """The version of a part of gsbench now; None for a user's module."""
    if part.kind == "module":
        return None
    if part.kind == "package":
        return state_of(part.name)
    return next((str(stage.version) for stage in STAGES if stage.name == part.name), "none")


def code_changes(made: Mapping[Part, str], now: Callable[[Part], str | None]) -> Iterator[Change]:
    """The parts of the code whose version is ``now`` known to be another one."""
    for part, version in made.items():
        present = now(part)
        if present not in (None, version):
            yield Change("code", part.short, version, present)


# ---- a trial and its files

# files that tables and reports read
READ_LATER = (layout.PER_VIEW, layout.CURVES, layout.EVENTS)
# files by which a trial is judged, exported or run again: after an edit it counts nowhere
JUDGED = (layout.PER_VIEW, layout.CONFIG, layout.POINT_CLOUD, layout.LINEAGE)
RECORDED = {*READ_LATER, *JUDGED}
# Files up to so many bytes are compared by content, since a flipped bit changes neither size nor
# time.
MAX_HASHED_BYTES = 1e6

# sha256 of files that this process has read, by device, inode and stamp
_digests: dict[Stamp, str] = {}


def origin_of(
    folder: Path,
    content: Mapping[str, Any],
    values: Values,
    sources: Iterable[Path],
    entries: Mapping[str, Path],
    published: Iterable[Path],
) -> MadeOf:
    """The origin of the trial in ``folder`` with the results ``content``.

    The arguments are those of `TrialFolder.write_finished`.
    """
    files = {*published, *(folder / name for name in RECORDED if (folder / name).is_file())}
    names = {file.relative_to(folder).as_posix(): file for file in sorted(files)}
    sources = sorted(sources)
    return MadeOf(
        results=sha256_of(content),
        config=config_hash(values),
        stages={stage.name: stage.version for stage in STAGES},
        pycolmap=version_of("pycolmap"),
        sources={str(source): stamp_of(source, 3) for source in sources},
        # Adding or removing a file changes its folder's time.
        folders={str(source.parent): _changed_at(source.parent) for source in sources},
        entries={name: str(entry) for name, entry in entries.items()},
        published={name: stamp_of(file) for name, file in names.items()},
        digests={
            name: file_sha256(file)
            for name, file in names.items()
            if name in RECORDED or file.stat().st_size <= MAX_HASHED_BYTES
        },
        settings=dict(values),
    )


def changes(folder: Path, values: Values, record: TrialRecord, made: MadeOf) -> Iterator[Change]:
    """The changes since the complete trial in ``folder`` was made, quickly found ones first.

    Files are compared by size and time of change, small files of gsbench's also by content.
    """
    present = config_hash(values)  # with the user's modules as this process has imported them
    if record.hashes.get("config") != present or made.config != present:
        yield Change("settings", layout.CONFIG, made.config, present)
    stages = {stage.name: "none" for stage in STAGES} | made.stages
    code = code_of(Code(packages=record.code.packages)) | {
        Part("stage", name): str(version) for name, version in stages.items()
    }
    yield from code_changes(code, present_version)
    if made.pycolmap != (installed := version_of("pycolmap")):
        yield Change("code", "pycolmap", str(made.pycolmap), str(installed))
    for source, stamp in made.sources.items():
        yield from _change_of(Path(source), stamp)
    for source_folder, changed in made.folders.items():
        if _changed_at(Path(source_folder)) != changed:
            yield Change("folder", source_folder)
    for name, stamp in made.published.items():
        yield from _change_of(folder / name, stamp)
        is_small = stamp[0] <= MAX_HASHED_BYTES
        if is_small and name in made.digests and digest_of(folder / name) != made.digests[name]:
            yield Change("file", str(folder / name))
    yield from damaged_entries(made)


def damaged_entries(made: MadeOf, thorough: bool = False) -> Iterator[Change]:
    """The results of a trial's stages in the store that are damaged or gone."""
    for name, entry in made.entries.items():
        try:
            read_manifest(Path(entry), thorough=thorough)
        except ValueError as error:
            yield Change("stored", name, now=str(error))


def changed_files(
    folder: Path, made: MadeOf, names: Iterable[str] = JUDGED, thorough: bool = False
) -> Iterator[Change]:
    """The files ``names`` of a trial with another content than when its results were written.

    A large file with its recorded size and time counts as unchanged, unless ``thorough``. Files
    that are gone do not count, since models are deleted to make room.
    """
    for name in names:
        path, recorded = folder / name, made.digests.get(name)
        if recorded is None or not path.is_file():
            continue
        known, stamp = made.published.get(name), stamp_of(path)
        is_large = stamp[0] > MAX_HASHED_BYTES
        # a file of another size may be too large to read
        has_changed = known is not None and known[0] != stamp[0]
        if not has_changed and (thorough or not is_large or known != stamp):
            has_changed = (file_sha256(path) if is_large else digest_of(path)) != recorded
        if has_changed:
            yield Change("written", name)


def stamp_of(path: Path, count: int = 2) -> Stamp:
    """Size, mtime and, of a user's file (``count`` 3), ctime; raises OSError.

    A program may replace a file and restore its mtime, but not its ctime. The ctime of gsbench's
    own files is not used: they are hard links, and each further link changes it.
    """
    state = os.stat(path)
    return (state.st_size, state.st_mtime_ns, state.st_ctime_ns)[:count]


def _change_of(path: Path, stamp: Stamp) -> Iterator[Change]:
    try:
        if stamp_of(path, len(stamp)) != stamp:
            yield Change("file", str(path))
    except (OSError, ValueError) as error:
        yield Change("unreadable", str(path), now=str(getattr(error, "strerror", error)))


def _changed_at(folder: Path) -> int | None:
    try:
        return folder.stat().st_mtime_ns
    except (OSError, ValueError):
        return None


def digest_of(path: Path) -> str | None:
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
