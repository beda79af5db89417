"""Zip archives of scenes, here or on a server, and what of them comes here: which members are wanted, and each checked.

Of an archive on a server only the directory and the wanted members come, each by a request of its own (remotezip). A
scene appears in the data folder when all that was missing of it is here.
"""

import lzma
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from errno import EINVAL
from pathlib import Path, PurePosixPath
from typing import IO

from gsbench.datasets.catalog import SceneFiles
from gsbench.downloads import USER_AGENT, FetchError, Patience, retried
from gsbench.errors import InputError
from gsbench.files import CHUNK, atomic, require_regular
from gsbench.logs import Progress
from gsbench.words import counted, readable_bytes

MAX_NAME_BYTES = 220  # file systems end at 255 for each folder, and a file that is being written has a longer name


class DamagedError(Exception):
    """Error of a file that is not what the archive's directory promises."""


@contextmanager
def opened(where: str, patience: Patience) -> Iterator[zipfile.ZipFile]:
    """The archive at an address, read by ranges, or at a path of this machine.

    Raises `InputError` where it cannot be read, is no archive, or lies on a server that sends whole files only.
    """
    if "://" in where:
        with _remote(where, patience) as archive:
            yield archive
        return
    path = Path(where).expanduser()
    require_regular(path)
    try:
        file = path.open("rb")
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): correct --mirror") from error
    with file, open_archive(file, str(path)) as archive:
        yield archive


@contextmanager
def _remote(url: str, patience: Patience) -> Iterator[zipfile.ZipFile]:
    import remotezip
    import requests

    def once() -> zipfile.ZipFile:
        try:
            return remotezip.RemoteZip(url, session=session, timeout=patience.timeout, headers=USER_AGENT)
        except remotezip.RangeNotSupported:
            raise InputError(
                f"{url}: the server sends whole files only: get the file into a folder, and give --mirror FOLDER"
            ) from None
        except remotezip.RemoteIOError as error:
            raise (error.__context__ or error) from None  # the library keeps the words of the cause alone
        except remotezip.RemoteZipError as error:
            raise zipfile.BadZipFile(str(error)) from None

    with requests.Session() as session:
        try:
            archive = retried(once, url, patience)
        except (zipfile.BadZipFile, NotImplementedError, ValueError, struct.error) as error:
            if isinstance(error, InputError):
                raise
            raise _no_archive(url, error) from error
        with archive:
            yield archive


def open_archive(file: IO[bytes], where: str) -> zipfile.ZipFile:
    """The zip archive in ``file``; `InputError`, one line naming ``where``, if it is none or has been cut."""
    try:
        return zipfile.ZipFile(file)
    except (zipfile.BadZipFile, NotImplementedError, ValueError, struct.error) as error:
        raise _no_archive(where, error) from error


def _no_archive(where: str, error: Exception) -> InputError:
    return InputError(f"{where} is not a complete zip archive ({error}): give another address with --mirror")


def members_of(archive: zipfile.ZipFile, folder: str, wanted: Sequence[str], where: str) -> dict[str, zipfile.ZipInfo]:
    """The files of the folders ``wanted`` below ``folder`` (and no others), by their names below it, sorted.

    Raises `InputError` where a wanted folder is empty, or a name would lead out of the scene's folder.
    """
    members: dict[str, zipfile.ZipInfo] = {}
    for info in archive.infolist():
        if not info.filename.startswith(f"{folder}/") or info.is_dir():
            continue
        name = info.filename[len(folder) + 1 :]
        if not any(name.startswith(f"{part}/") for part in wanted) or "/." in f"/{name}":
            continue  # hidden files, ".." among them, are never wanted
        if "\\" in name or "//" in name or ":" in name or PurePosixPath(name).is_absolute():
            raise InputError(f"{where}: the member {info.filename!r} has an unsafe name: give another --mirror")
        if len(name.encode("utf-8", "surrogatepass")) > MAX_NAME_BYTES or not name.isprintable():
            raise InputError(
                f"{where}: the member {name!r:.80} has a name that no file can have: give another --mirror"
            )
        members[name] = info
    for name in members:
        if folder_of := next((str(above) for above in PurePosixPath(name).parents if str(above) in members), None):
            raise InputError(f"{where}: {folder_of} is a file and a folder in one: give another --mirror")
    for part in wanted:
        if not any(name.startswith(f"{part}/") for name in members):
            raise InputError(f"{where} has no files below {folder}/{part}: it is not the archive that was expected")
    return dict(sorted(members.items()))


def holds(path: Path, size: int, crc: int) -> bool:
    """Return whether the file ``path`` is there with this size and CRC-32."""
    try:
        if path.stat().st_size != size:
            return False
        checksum = 0
        with path.open("rb") as file:
            while piece := file.read(CHUNK):
                checksum = zlib.crc32(piece, checksum)
    except OSError:
        return False
    return checksum == crc


def extract(archive: zipfile.ZipFile, member: zipfile.ZipInfo, target: Path, advance: Callable[[int], None]) -> None:
    """Write the member to ``target``, which appears only when size and CRC-32 are right; ``advance`` gets bytes.

    Raises `DamagedError`, `InputError` for a member that the archive has packed in a way not known here, and what the
    network raises.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    written = 0
    try:
        with (
            atomic(target, sync=False) as temporary,  # a later fetch reads what is here and compares its CRC
            archive.open(member) as source,
            temporary.open("wb") as file,
        ):
            while piece := source.read(CHUNK):  # checks the CRC at the end
                file.write(piece)
                written += len(piece)
                advance(len(piece))
            if written != member.file_size:
                raise DamagedError(f"{written} bytes instead of {member.file_size}")
    except Exception as error:
        advance(-written)
        raise _cause(error, member) from error


# The kinds of error that zipfile and its decompressors raise for damaged bytes; the last two are of LZMA's filter.
DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, lzma.LZMAError, EOFError, ValueError, IndexError, TypeError)


def _cause(error: Exception, member: zipfile.ZipInfo) -> Exception:
    """The error to raise for one that `extract` met: of the file, of gsbench, else the error itself."""
    from remotezip import RemoteIOError, RemoteZipError

    if isinstance(error, InputError | DamagedError):
        return error
    if isinstance(error, RemoteIOError):
        cause = error.__context__
        return cause if isinstance(cause, Exception) else error
    # Of the system's errors, EINVAL is a place before the file's beginning; bzip2's own has no number.
    if isinstance(error, (*DAMAGE, RemoteZipError)) or (isinstance(error, OSError) and error.errno in (None, EINVAL)):
        return DamagedError(str(error) or type(error).__name__)
    if isinstance(error, NotImplementedError | RuntimeError):
        return InputError(f"{member.filename} is packed in a way that cannot be read here ({error})")
    return error


STAGING = ".fetch"  # below the data folder: what has come so far


def missing_parts(data: Path, files: SceneFiles) -> tuple[str, ...]:
    """The folders of a scene that are not in the folder ``data``; one that is there is whole."""
    return tuple(part for part in files.parts if not (data / files.folder / part).exists())


def fetch_scene(
    archive: zipfile.ZipFile, folder: str, where: str, data: Path, files: SceneFiles, patience: Patience, say: Progress
) -> str:
    """Bring what is missing of a scene out of its ``archive``, where it lies in ``folder``; returns a line about it.

    ``where`` is the archive's place, for errors; ``say`` is told bytes. The caller holds the lock of ``data``.
    """
    parts, staging = missing_parts(data, files), data / STAGING / files.scene
    members = members_of(archive, folder, parts, where)
    for path in [path for path in staging.rglob("*") if path.is_file()]:
        if path.relative_to(staging).as_posix() not in members:
            path.unlink()  # of an earlier fetch that wanted something else
    missing = {
        name: info for name, info in members.items() if not holds(staging / name, info.file_size, info.CRC)
    }  # of what came before it was stopped, nothing comes again
    total, done = sum(info.file_size for info in missing.values()), 0

    def advance(count: int) -> None:
        nonlocal done
        done += count
        say(files.scene, done, total)

    for name, info in sorted(missing.items(), key=lambda member: member[1].header_offset):
        for is_last_try in (False, True):  # of damage on the way; a cut connection is tried again within
            try:
                retried(lambda: extract(archive, info, staging / name, advance), where, patience)  # noqa: B023
                break
            except DamagedError as error:
                if is_last_try:
                    raise FetchError(
                        f"{where}: {info.filename} arrives damaged ({error}): try again later, or give another address "
                        "with --mirror"
                    ) from error
    for part in parts:  # each by one rename, so that no folder of images is ever half there
        (data / files.folder / part).parent.mkdir(parents=True, exist_ok=True)
        shutil.move(staging / part, data / files.folder / part)
    shutil.rmtree(staging, ignore_errors=True)
    size = sum(info.file_size for info in members.values())
    return f"{counted(len(members), 'file')}, {readable_bytes(size)}, in {data / files.folder} ({', '.join(parts)})"
