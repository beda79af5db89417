"""Files that are whole or absent, and what to say when the disk is full or cannot be written to."""

import errno
import hashlib
import json
import os
import re
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gsbench.errors import GsbenchError, InputError

CHUNK = 1 << 20
TEMPORARY = re.compile(r"^\..+\.tmp(-\d+)?$")  # how gsbench names a file that it is still writing
FULL = (errno.ENOSPC, errno.EDQUOT)
BROKEN = (errno.EIO, errno.ELOOP, errno.ESTALE)
FORBIDDEN = (errno.EROFS, errno.EACCES, errno.EPERM)
# Messages of libraries, without an error number, when a write is cut short: numpy's tofile, torch's zip writer, SQLite.
FULL_TEXT = re.compile(
    r"No space left|requested and \d+ written|PytorchStreamWriter failed|unexpected pos|disk is full"
)
NEARLY_NOTHING = 64 * 1024  # bytes free: with less, any failed write is a full disk


class DiskFullError(GsbenchError):
    """Error of a full disk of the runs folder: no trial can go on (exit code 1)."""


@contextmanager
def atomic(path: Path, sync: bool = True) -> Iterator[Path]:
    """Give the block a temporary path beside ``path`` to write; published under its name by a rename when it ends well.

    A reader sees the old file or the new one, never a part. What an error leaves is removed; what a kill leaves is
    hidden, and `remove_temporaries` finds it. ``sync``: wait until the content is on the disk before it is published.
    """
    temporary = path.with_name(f".{path.name}.tmp-{os.getpid()}")
    temporary.unlink(missing_ok=True)
    try:
        yield temporary
        if sync:
            with temporary.open("rb+") as stream:
                os.fsync(stream.fileno())  # where writing is delayed, here a full disk is noticed
        os.replace(temporary, path)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)  # os.replace leaves it where both are links to one file


def write_json(path: Path, values: Any) -> None:
    """Write JSON, whole or not at all. NaN and infinity are refused."""
    write_text(path, json.dumps(values, indent=1, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def place_of(out: Path) -> Iterator[None]:
    """Make the folder of what ``--out`` names for the block that writes it.

    Raises InputError for an OSError of the block: the place was asked for, and another mends it.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise InputError(f"cannot write {out} ({error.strerror or error}); give another --out") from error


def link_or_copy(source: Path, target: Path) -> None:
    """Show ``source`` as ``target`` too, as a hard link where the file system has them; replaces what is there."""
    with atomic(target, sync=False) as temporary:
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)


def open_plain(path: Path, flags: int = os.O_RDONLY) -> int:
    """A descriptor of the regular file ``path``, whose last part is no link.

    Raises InputError for a link, and for a pipe or a device, whose reading need not end; OSError as `os.open` does.
    """
    flags |= getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):  # a link; a pipe that nobody reads
            raise _no_plain_file(path) from None
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise _no_plain_file(path)
    return descriptor


def require_own(runs: Path, place: Path, below: bool = False) -> None:
    """Raise InputError where a part of the way from the folder ``runs`` to ``place`` is a link, a pipe or a device.

    With ``below``, also where something in the folder ``place`` is. What is not there is let pass.
    """
    # A runs folder that somebody sends may hold links: what we write to `log.txt` would come into the file behind it,
    # and what we pack or publish would come from there.
    way = runs
    for part in place.relative_to(runs).parts:
        way /= part
        with suppress(FileNotFoundError, NotADirectoryError):
            _require_plain(way, os.lstat(way).st_mode)
    waiting = [place] if below else []
    while waiting:
        with suppress(FileNotFoundError, NotADirectoryError), os.scandir(waiting.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(Path(entry.path))
                elif not entry.is_file(follow_symlinks=False):
                    raise _no_plain_file(Path(entry.path))


def remove_strange(folder: Path) -> None:
    """Remove the links, pipes and devices below ``folder``; what they lead to stays."""
    for path in sorted(folder.rglob("*")):
        mode = os.lstat(path).st_mode
        if not stat.S_ISDIR(mode) and not stat.S_ISREG(mode):
            path.unlink()


def _require_plain(path: Path, mode: int) -> None:
    if not stat.S_ISDIR(mode) and not stat.S_ISREG(mode):
        raise _no_plain_file(path)


def _no_plain_file(path: Path) -> InputError:
    return InputError(
        f"{path} is a link or not a regular file, and gsbench follows no links in a runs folder: remove it"
    )


def require_regular(path: Path) -> None:
    """Raise InputError for a pipe, a device or a socket, whose reading need not end; what is not there is let pass."""
    with suppress(OSError):
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
            raise InputError(f"{path} is not a regular file: put a copy of its content there")


def sync_to_disk(path: Path) -> None:
    """Wait until a file or folder is on the disk, where the system can say so."""
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def remove_temporaries(folder: Path) -> None:
    """Remove what killed writers left below ``folder``; nobody may be writing there."""
    for path in folder.rglob(".*"):
        if TEMPORARY.match(path.name) and path.is_file():
            with suppress(OSError):
                path.unlink()


def checked_runs_folder(name: str) -> Path:
    """The runs folder called ``name``, made absolute; it need not be there yet.

    Raises InputError where a folder of this name can neither be there nor be made.
    """
    advice = "set runs=FOLDER or GSBENCH_RUNS to another folder"
    try:
        folder = Path(name).expanduser().resolve()
        existing = next(place for place in (folder, *folder.parents) if place.exists())
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{name!r} cannot be the runs folder ({error}): {advice}") from error
    if name.strip() == "":
        raise InputError(f"the runs folder has no name: {advice}")
    if not existing.is_dir():
        raise InputError(f"the runs folder {folder} cannot be made, because {existing} is a file: {advice}")
    return folder


def make_runs_folder(folder: Path) -> None:
    """Make the runs folder, and see that it can be filled.

    Raises InputError where it cannot, and OSError where the disk is full or writing is forbidden (`storage_errors`).
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".probe-", dir=folder):
            pass
    except OSError as error:
        if error.errno in (*FULL, *FORBIDDEN):
            raise
        raise InputError(
            f"{folder} cannot be the runs folder ({error.strerror}): set runs=FOLDER or GSBENCH_RUNS to another folder"
        ) from error


@contextmanager
def storage_errors(folder: Path) -> Iterator[None]:
    """Turn a full disk and forbidden writing within the block into one line that names ``folder``."""
    try:
        yield
    except Exception as error:
        found = explain_storage(error, folder)
        if found is None or isinstance(error, GsbenchError):
            raise
        raise found from error


def explain_storage(error: BaseException, folder: Path) -> GsbenchError | None:
    """The error in gsbench's words if storage is its cause, else None."""
    number = error.errno if isinstance(error, OSError) else None
    place = getattr(error, "filename", None) or folder
    if number in FULL or FULL_TEXT.search(str(error)) or (_is_write_error(error) and _free(folder) < NEARLY_NOTHING):
        return DiskFullError(
            f"the disk of {folder} is full: free some space, then give the same command again: it continues"
        )
    if number == errno.EFBIG:
        return InputError(
            f"{place} may not grow any more ({os.strerror(number)}): raise `ulimit -f`, or set runs=FOLDER"
        )
    if number == errno.ENOLCK:
        return InputError(
            f"the file system of {place} has no locks ({os.strerror(number)}), so trials would disturb each other: "
            "set runs=FOLDER or GSBENCH_RUNS to another file system, or start its lock service"
        )
    if number in BROKEN:
        return InputError(
            f"{place} cannot be opened ({os.strerror(number)}): look at its disk and its links, or set runs=FOLDER"
        )
    if number in FORBIDDEN:
        return InputError(f"{place} cannot be written to ({os.strerror(number)}): set runs=FOLDER or GSBENCH_RUNS")
    return None


def _is_write_error(error: BaseException) -> bool:
    return isinstance(error, (OSError, RuntimeError))


def _free(folder: Path) -> int:
    place = folder
    while not place.exists() and place != place.parent:
        place = place.parent
    try:
        usage = shutil.disk_usage(place)
    except OSError:
        return NEARLY_NOTHING
    return usage.free if usage.total else NEARLY_NOTHING  # a file system without a size, such as /proc, is never full


def file_sha256(path: Path) -> str:
    """The sha256 of a file's content, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
