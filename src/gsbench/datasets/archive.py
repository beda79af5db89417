"""Fetching scenes from zip archives: selecting the wanted members and checking each.

From an archive on a server only the directory and the wanted members are read, each with its own
request (remotezip). The missing folders of a scene appear in the data folder once all of them are
complete.
"""

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
from gsbench.downloads import USER_AGENT, FetchError, RetryPolicy, with_retries
from gsbench.errors import InputError
from gsbench.files import CHUNK, MAX_NAME_BYTES, atomic, is_safe_member, require_regular
from gsbench.logs import Progress
from gsbench.words import counted, readable_bytes

# raised by zipfile for a file that is no archive, or only its beginning
NO_ARCHIVE = (zipfile.BadZipFile, NotImplementedError, ValueError, struct.error)


class DamagedMemberError(Exception):
    """Raised for a member whose content does not match the archive's directory."""


@contextmanager
def open_archive_at(where: str, policy: RetryPolicy) -> Iterator[zipfile.ZipFile]:
    """Open the archive at an address, which is read by ranges, or at a path of this machine.

    Raises `InputError` if it cannot be read or is not an archive, or if its server only sends whole
    files.
    """
    if "://" in where:
        with _remote(where, policy) as archive:
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
def _remote(url: str, policy: RetryPolicy) -> Iterator[zipfile.ZipFile]:
    import remotezip
    import requests

    def once() -> zipfile.ZipFile:
        try:
            return remotezip.RemoteZip(
                url, session=session, timeout=policy.timeout, headers=USER_AGENT
            )
        except remotezip.RangeNotSupported:
            raise InputError(
                f"{url}: the server sends whole files only: get the file into a folder, and give "
                "--mirror FOLDER"
            ) from None
        except remotezip.RemoteIOError as error:
            # remotezip keeps only the text of the cause
            raise (error.__context__ or error) from None
        except remotezip.RemoteZipError as error:
            raise zipfile.BadZipFile(str(error)) from None

    with requests.Session() as session:
        with _opening(url):
            archive = with_retries(once, url, policy)
        with archive:
            yield archive


def open_archive(file: IO[bytes], where: str) -> zipfile.ZipFile:
    """Open the zip archive in ``file``; raises `InputError` naming ``where`` if it is none."""
    with _opening(where):
        return zipfile.ZipFile(file)


@contextmanager
def _opening(where: str) -> Iterator[None]:
    try:
        yield
    except InputError:  # a ValueError, too
        raise
    except NO_ARCHIVE as error:
        raise InputError(
            f"{where} is not a complete zip archive ({error}): give another address with --mirror"
        ) from error


def wanted_members(
    archive: zipfile.ZipFile, folder: str, wanted: Sequence[str], where: str
) -> dict[str, zipfile.ZipInfo]:
    """The members in the folders ``wanted`` below ``folder``, by their names below it, sorted.

    Raises `InputError` if a wanted folder is empty, or if a name would lead out of the scene's
    folder.
    """
    members: dict[str, zipfile.ZipInfo] = {}
    for info in archive.infolist():
        if not info.filename.startswith(f"{folder}/") or info.is_dir():
            continue
        name = info.filename[len(folder) + 1 :]
        if not any(name.startswith(f"{part}/") for part in wanted) or "/." in f"/{name}":
            continue  # hidden files, including "..", are never wanted
        # A damaged name may decode to surrogates.
        too_long = len(name.encode("utf-8", "surrogatepass")) > MAX_NAME_BYTES
        is_odd = too_long or not name.isprintable() or "//" in name or ":" in name
        if is_odd or not is_safe_member(name):
            raise InputError(
                f"{where}: the member {name!r:.80} has an unsafe name, or a name that no file can "
                "have: give another --mirror"
            )
        members[name] = info
    for name in members:
        for above in map(str, PurePosixPath(name).parents):
            if above in members:
                raise InputError(
                    f"{where}: {above} is a file and a folder in one: give another --mirror"
                )
    for part in wanted:
        if not any(name.startswith(f"{part}/") for name in members):
            raise InputError(
                f"{where} has no files below {folder}/{part}: it is not the archive that was "
                "expected"
            )
    return dict(sorted(members.items()))


def is_complete(path: Path, size: int, crc: int) -> bool:
    """Return whether the file ``path`` exists with this size and CRC-32."""
    has_size = path.is_file() and path.stat().st_size == size
    return has_size and zlib.crc32(path.read_bytes()) == crc


def extract(
    archive: zipfile.ZipFile, member: zipfile.ZipInfo, target: Path, advance: Callable[[int], None]
) -> None:
    """Write the member to ``target``, whole or not at all; ``advance`` gets byte counts.

    Raises `DamagedMemberError`, `InputError` for an unknown compression, and errors of the network.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    written = 0
    try:
        with (  # not synced, because a later fetch checks the CRC of existing files
            atomic(target, sync=False) as temporary,
            archive.open(member) as source,
            temporary.open("wb") as file,
        ):
            while piece := source.read(CHUNK):  # zipfile checks the CRC at the end
                file.write(piece)
                written += len(piece)
                advance(len(piece))
            if written != member.file_size:
                raise DamagedMemberError(f"{written} bytes instead of {member.file_size}")
    except Exception as error:
        advance(-written)
        raise _cause(error, member) from error


def _cause(error: Exception, member: zipfile.ZipInfo) -> Exception:
    """The error that `extract` raises: of the network or disk as it is, else damage."""
    import requests
    import urllib3
    from remotezip import RemoteIOError

    if isinstance(error, RemoteIOError) and isinstance(error.__context__, Exception):
        error = error.__context__
    if isinstance(error, requests.RequestException | urllib3.exceptions.HTTPError | RemoteIOError):
        return error
    if isinstance(error, RuntimeError):  # a password, or an unknown compression
        return InputError(
            f"{member.filename} is packed in a way that cannot be read here ({error})"
        )
    # zipfile and its decompressors raise almost any exception on damaged bytes, among them an
    # OSError for a seek before the start of the file.
    is_of_disk = isinstance(error, OSError) and error.errno not in (None, EINVAL)
    if is_of_disk or isinstance(error, InputError | DamagedMemberError | MemoryError):
        return error
    return DamagedMemberError(str(error) or type(error).__name__)


STAGING = ".fetch"  # folder of unfinished scenes, below the data folder


def missing_parts(data: Path, files: SceneFiles) -> tuple[str, ...]:
    """The folders of a scene that are not in ``data``. An existing folder is complete."""
    return tuple(part for part in files.parts if not (data / files.folder / part).exists())


def fetch_scene(
    archive: zipfile.ZipFile,
    folder: str,
    where: str,
    data: Path,
    files: SceneFiles,
    policy: RetryPolicy,
    say: Progress,
) -> str:
    """Fetch the missing folders of a scene from its ``archive``; returns one line about them.

    ``where`` is the archive's address, for errors; ``say`` gets byte counts. The caller holds the
    lock of ``data``.
    """
    parts, staging = missing_parts(data, files), data / STAGING / files.scene
    members = wanted_members(archive, folder, parts, where)
    for path in [path for path in staging.rglob("*") if path.is_file()]:
        if path.relative_to(staging).as_posix() not in members:
            path.unlink()  # from an earlier fetch of other folders
    # members that an interrupted fetch completed are not fetched again
    missing = {
        name: info
        for name, info in members.items()
        if not is_complete(staging / name, info.file_size, info.CRC)
    }
    total, done = sum(info.file_size for info in missing.values()), 0

    def advance(count: int) -> None:
        nonlocal done
        done += count
        say(files.scene, done, total)

    for name, info in sorted(missing.items(), key=lambda member: member[1].header_offset):
        # Two tries against damage in transit; `with_retries` handles lost connections.
        for is_last_try in (False, True):
            try:
                with_retries(lambda: extract(archive, info, staging / name, advance), where, policy)  # noqa: B023
                break
            except DamagedMemberError as error:
                if is_last_try:
                    raise FetchError(
                        f"{where}: {info.filename} arrives damaged ({error}): try again later, or "
                        "give another address with --mirror"
                    ) from error
    for part in parts:  # each by one rename, so that no folder of images is ever incomplete
        (data / files.folder / part).parent.mkdir(parents=True, exist_ok=True)
        shutil.move(staging / part, data / files.folder / part)
    shutil.rmtree(staging, ignore_errors=True)
    size = sum(info.file_size for info in members.values())
    return (
        f"{counted(len(members), 'file')}, {readable_bytes(size)}, in {data / files.folder} "
        f"({', '.join(parts)})"
    )
