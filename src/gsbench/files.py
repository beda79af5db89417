"""Atomic writing of files, protection against links, and messages about full or read-only disks."""

import errno
import hashlib
import json
import lzma
import os
import re
import shutil
import stat
import struct
import tarfile
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath, PureWindowsPath
from tempfile import TemporaryDirectory
from typing import Any

from gsbench.errors import GsbenchError, InputError
from gsbench.words import is_one_line

CHUNK = 1 << 20
# Of a file name. File systems allow 255, but the temporary name of a file that is being written is
# longer.
MAX_NAME_BYTES = 220
TEMPORARY = re.compile(r"^\..+\.tmp(-\d+)?$")  # name of a file that gsbench is still writing
FULL = (errno.ENOSPC, errno.EDQUOT)
BROKEN = (errno.EIO, errno.ELOOP, errno.ESTALE)
FORBIDDEN = (errno.EROFS, errno.EACCES, errno.EPERM)
# Libraries' messages without an error number for an incomplete write: numpy's tofile, torch's zip
# writer, SQLite.
FULL_TEXT = re.compile(
    r"No space left|requested and \d+ written|PytorchStreamWriter failed|unexpected pos|disk is "
    r"full"
)
# Errors that readers of arrays, pictures and archives (numpy, plyfile, zipfile, tarfile and their
# decompressors) raise for a damaged file. MemoryError: a header may announce any number of values.
DAMAGE = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    EOFError,
    ArithmeticError,
    MemoryError,
    RuntimeError,
    SyntaxError,
    struct.error,
    tokenize.TokenError,
    zlib.error,
    lzma.LZMAError,
    zipfile.BadZipFile,
    tarfile.TarError,
)
GIT_LFS = b"version https://git-lfs"  # the start of a pointer that stands for a file
LFS_REMEDY = "a pointer of Git LFS (git lfs pull)"
NEARLY_NOTHING = 64 * 1024  # free bytes; with less, any failed write counts as a full disk


class DiskFullError(GsbenchError):
    """Raised if the disk of the runs folder is full: no trial can continue (exit code 1)."""


@contextmanager
def atomic(path: Path, sync: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, and rename it to ``path`` if the block succeeds.

    A reader sees the old file or the new one, never a part. After an error the temporary file is
    removed. A killed process leaves a hidden file, which `remove_temporaries` removes. With
    ``sync``, the content is written to the disk before the rename.
    """
    temporary = path.with_name(f".{path.name}.tmp-{os.getpid()}")
    temporary.unlink(missing_ok=True)
    try:
        yield temporary
        if sync:
            with temporary.open("rb+") as stream:
                os.fsync(stream.fileno())  # with delayed writing, a full disk is only noticed here
        os.replace(temporary, path)
    finally:
        with suppress(OSError):
            # os.replace does nothing if both names are links to one file
            temporary.unlink(missing_ok=True)


def write_json(path: Path, values: Any) -> None:
    """Write a JSON file atomically. NaN and infinity raise ValueError."""
    write_text(path, json.dumps(values, indent=1, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically; a name that is not UTF-8 is escaped, as ``\\udcff``."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


@contextmanager
def writable_output(out: Path) -> Iterator[None]:
    """Make the parent folder of ``out``, the value of ``--out``, for the block that writes it.

    Turns an OSError of the block into an InputError that asks for another ``--out``.
    """
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise InputError(
            f"cannot write {out} ({error.strerror or error}); give another --out"
        ) from error


def user_cache(name: str) -> Path:
    """The folder ``name`` of gsbench's in the user's cache, which may not be there yet.

    A relative ``XDG_CACHE_HOME`` is ignored, as XDG's specification asks: it would mean a folder of
    the current one, which may be a stranger's.
    """
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    cache = given if given.is_absolute() else Path(os.path.expanduser("~/.cache"))
    return cache / "gsbench" / name


OUTPUTS = ".gsbench-outputs"  # in a folder of the user's: the sha256 of what gsbench wrote there


@contextmanager
def own_output(file: Path) -> Iterator[None]:
    """`writable_output` for a file whose name gsbench chose, as in a folder that the user named.

    Raises InputError if there is such a file that gsbench did not write, or that was edited since.
    """
    record = file.parent / OUTPUTS
    known = record.read_text().split() if record.is_file() and not record.is_symlink() else []
    if file.exists() and (not file.is_file() or file_sha256(file) not in known):
        raise InputError(
            f"{file} is there already, and is not as gsbench wrote it: move it, or give another "
            "--out"
        )
    with writable_output(file):
        yield
        if (written := file_sha256(file)) not in known:
            write_text(record, "\n".join([*known, written]) + "\n")


def link_or_copy(source: Path, target: Path) -> None:
    """Make ``target`` a hard link to ``source``, or a copy where hard links do not work.

    Replaces ``target``.
    """
    with atomic(target, sync=False) as temporary:
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)


def open_plain(path: Path, flags: int = os.O_RDONLY) -> int:
    """Open the regular file ``path`` and return its descriptor.

    A link as the last part is not followed. Raises InputError for a link, a pipe or a device (whose
    reading may never end), and OSError as `os.open` does.
    """
    flags |= (
        getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    )
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO):  # a link; a pipe without a reader
            raise _no_plain_file(path) from None
        raise
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise _no_plain_file(path)
    return descriptor


def require_no_links(runs: Path, place: Path, below: bool = False) -> None:
    """Raise InputError if a part of the path ``place`` is a link, a pipe or a device.

    Parts above the folder ``runs`` are not looked at. With ``below``, everything in the folder
    ``place`` is checked too. Missing parts are allowed.
    """
    # A runs folder from someone else may hold links. Through them, a log would overwrite files
    # outside the folder, and packing or publishing would include such files.
    path = str(runs)  # texts, since thousands of trials come here
    for part in place.relative_to(runs).parts:
        path = os.path.join(path, part)
        with suppress(FileNotFoundError, NotADirectoryError):
            if _is_special(os.lstat(path).st_mode):
                raise _no_plain_file(path)
    folders = [str(place)] if below else []
    while folders:
        with suppress(FileNotFoundError, NotADirectoryError), os.scandir(folders.pop()) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(entry.path)
                elif not entry.is_file(follow_symlinks=False):
                    raise _no_plain_file(entry.path)


def remove_special_files(folder: Path) -> None:
    """Remove the links, pipes and devices below ``folder``, but not the targets of links."""
    for path in sorted(folder.rglob("*")):
        if _is_special(os.lstat(path).st_mode):
            path.unlink()


def _is_special(mode: int) -> bool:
    """Return whether it is the mode of a link, a pipe, a device or a socket."""
    return not stat.S_ISDIR(mode) and not stat.S_ISREG(mode)


def _no_plain_file(path: str | Path) -> InputError:
    return InputError(
        f"{path} is a link or not a regular file, and gsbench follows no links in a runs folder: "
        "remove it"
    )


def require_regular(path: Path) -> None:
    """Raise InputError for a pipe, a device or a socket, whose reading may never end.

    A missing file is allowed.
    """
    with suppress(OSError):
        if _is_special(path.stat().st_mode):
            raise InputError(f"{path} is not a regular file: put a copy of its content there")


def is_safe_member(name: str) -> bool:
    """Return whether the file of this name in an archive stays below the folder it is unpacked to.

    Backslashes and drives lead out on Windows. No file can have a name with a NUL or a line break.
    """
    path = PurePosixPath(name)
    leads_out = path.is_absolute() or ".." in path.parts
    leads_out |= "\\" in name or bool(PureWindowsPath(name).drive)
    return not leads_out and bool(path.parts) and is_one_line(name)


def sync_to_disk(path: Path) -> None:
    """Wait until a file or folder is written to the disk, if the system supports that."""
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def remove_temporaries(folder: Path) -> None:
    """Remove temporary files of killed processes below ``folder``.

    No process may be writing there.
    """
    for path in folder.rglob(".*"):
        if TEMPORARY.match(path.name) and path.is_file():
            with suppress(OSError):
                path.unlink()


def checked_runs_folder(name: str) -> Path:
    """The absolute path of the runs folder ``name``, which need not exist yet.

    Raises InputError if no folder of this name can exist.
    """
    advice = "set runs=FOLDER or GSBENCH_RUNS to another folder"
    try:
        # Records of trials have the current folder, too.
        if strange := [place for place in (name, os.getcwd()) if not is_one_line(place)]:
            raise InputError(
                f"the name of {strange[0]} is not UTF-8, or has a line break: rename it"
            )
        folder = Path(name).expanduser().resolve()
        existing = _existing(folder)
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{name!r} cannot be the runs folder ({error}): {advice}") from error
    if name.strip() == "":
        raise InputError(f"the runs folder has no name: {advice}")
    if not existing.is_dir():
        raise InputError(
            f"the runs folder {folder} cannot be made, because {existing} is a file: {advice}"
        )
    return folder


def make_runs_folder(name: str | Path) -> None:
    """Make the runs folder, and check that it can be written to.

    Raises OSError if the disk is full or writing is forbidden (see `storage_errors`), else
    InputError, as `checked_runs_folder` does.
    """
    folder = checked_runs_folder(str(name))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".probe-", dir=folder):
            pass
    except OSError as error:
        if error.errno in (*FULL, *FORBIDDEN):
            raise
        raise InputError(
            f"{folder} cannot be the runs folder ({error.strerror}): set runs=FOLDER or "
            "GSBENCH_RUNS to another folder"
        ) from error


@contextmanager
def storage_errors(folder: Path) -> Iterator[None]:
    """Turn errors of a full or read-only disk into one line that names ``folder``."""
    try:
        yield
    except Exception as error:
        explained = explain_storage(error, folder)
        if explained is None or isinstance(error, GsbenchError):
            raise
        raise explained from error


def explain_storage(error: BaseException, folder: Path) -> GsbenchError | None:
    """An error of gsbench that explains ``error`` if its cause is storage, else None."""
    number = error.errno if isinstance(error, OSError) else None
    place = getattr(error, "filename", None) or folder
    if (
        number in FULL
        or FULL_TEXT.search(str(error))
        or (isinstance(error, (OSError, RuntimeError)) and _free(folder) < NEARLY_NOTHING)
    ):
        return DiskFullError(
            f"the disk of {folder} is full: free some space, then give the same command again: it "
            "continues"
        )
    faults = {
        errno.EFBIG: "{0} may not grow any more ({1}): raise `ulimit -f`, or set runs=FOLDER",
        errno.ENOLCK: "the file system of {0} has no locks ({1}), so trials would disturb each "
        "other: set runs=FOLDER or GSBENCH_RUNS to another file system, or start its lock service",
        **dict.fromkeys(
            BROKEN, "{0} cannot be opened ({1}): look at its disk and its links, or set runs=FOLDER"
        ),
        **dict.fromkeys(
            FORBIDDEN, "{0} cannot be written to ({1}): set runs=FOLDER or GSBENCH_RUNS"
        ),
    }
    return (
        InputError(faults[number].format(place, os.strerror(number))) if number in faults else None
    )


def _existing(folder: Path) -> Path:
    """The folder, or the nearest one above it that exists."""
    return next(place for place in (folder, *folder.parents) if place.exists())


def _free(folder: Path) -> int:
    try:
        usage = shutil.disk_usage(_existing(folder))
    except OSError:
        return NEARLY_NOTHING
    # file systems without a size, such as /proc, are never full
    return usage.free if usage.total else NEARLY_NOTHING


def file_sha256(path: Path) -> str:
    """The sha256 of a file's content, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
