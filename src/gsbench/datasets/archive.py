"""Zip archives of scenes: which members are wanted, and each of them on the disk, whole and with the right checksum."""

from __future__ import annotations

import errno
import lzma
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from gsbench.errors import InputError
from gsbench.files import CHUNK, atomic

MAX_NAME_BYTES = 220  # file systems end at 255 for each folder, and a file that is being written has a longer name
RUN_GAP_BYTES = 1 << 18  # members closer than this are read in one request, the gap with them


class DamagedError(Exception):
    """Error of a file that is not what the archive's directory promises."""


@dataclass(frozen=True)
class Member:
    """A wanted file: ``name`` below the scene's folder, and its entry in the archive's directory."""

    name: str
    info: zipfile.ZipInfo

    @property
    def bytes(self) -> int:
        return self.info.file_size


def open_archive(file: IO[bytes], where: str) -> zipfile.ZipFile:
    """The zip archive in ``file``; `InputError`, one line naming ``where``, if it is none or has been cut."""
    try:
        return zipfile.ZipFile(file)
    except Exception as error:  # zipfile raises many kinds where the directory is damaged or of a later version
        if isinstance(error, OSError):
            raise
        raise InputError(f"{where} is no whole zip archive ({error}): give another address with --mirror") from error


def members_of(archive: zipfile.ZipFile, folder: str, wanted: Sequence[str], where: str) -> list[Member]:
    """The files of the folders ``wanted`` below ``folder`` (and no others), sorted by name.

    Raises `InputError` where a wanted folder is empty, or a name would lead out of the scene's folder.
    """
    members: dict[str, Member] = {}
    for info in archive.infolist():
        if not info.filename.startswith(f"{folder}/") or info.is_dir():
            continue
        name = info.filename[len(folder) + 1 :]
        if not any(name.startswith(f"{part}/") for part in wanted) or "/." in f"/{name}":
            continue  # hidden files, ".." among them, are never wanted
        if "\\" in name or "//" in name or ":" in name or PurePosixPath(name).is_absolute():
            raise InputError(f"{where}: the member {info.filename!r} has an unsafe name: give another --mirror")
        members[name] = Member(name, info)
    for name in members:
        if len(name.encode("utf-8", "surrogatepass")) > MAX_NAME_BYTES or not name.isprintable():
            raise InputError(
                f"{where}: the member {name!r:.80} has a name that no file can have: give another --mirror"
            )
        if folder_of := next((str(above) for above in PurePosixPath(name).parents if str(above) in members), None):
            raise InputError(f"{where}: {folder_of} is a file and a folder in one: give another --mirror")
    for part in wanted:
        if not any(name.startswith(f"{part}/") for name in members):
            raise InputError(f"{where} has no files below {folder}/{part}: it is not the archive that was expected")
    return [members[name] for name in sorted(members)]


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


def runs_of(archive: zipfile.ZipFile, members: Sequence[Member]) -> Iterator[tuple[list[Member], int]]:
    """The members in the archive's order, in runs that lie close together, each with the byte where the run ends."""
    starts = sorted(info.header_offset for info in archive.infolist())
    ends = dict(zip(starts, [*starts[1:], archive.start_dir], strict=True))
    run: list[Member] = []
    end = 0
    for member in sorted(members, key=lambda member: member.info.header_offset):
        if run and member.info.header_offset - end > RUN_GAP_BYTES:
            yield run, end
            run = []
        run.append(member)
        end = ends[member.info.header_offset]
    if run:
        yield run, end


def extract(archive: zipfile.ZipFile, member: Member, target: Path, advance: Callable[[int], None]) -> None:
    """Write the member to ``target``, which appears only when size and CRC-32 are right; ``advance`` gets bytes.

    Raises `DamagedError`, and `InputError` for a member that the archive has packed in a way not known here.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    written = 0
    try:
        with (
            atomic(target, sync=False) as temporary,  # a later fetch reads what is here and compares its CRC
            archive.open(member.info) as source,
            temporary.open("wb") as file,
        ):
            while piece := source.read(CHUNK):  # checks the CRC at the end
                file.write(piece)
                written += len(piece)
                advance(len(piece))
            if written != member.bytes:
                raise DamagedError(f"{written} bytes instead of {member.bytes}")
    except (zipfile.BadZipFile, zlib.error, struct.error, lzma.LZMAError, EOFError, ValueError, DamagedError) as error:
        if isinstance(error, InputError):
            raise
        advance(-written)
        raise DamagedError(str(error) or type(error).__name__) from error
    except OSError as error:
        if error.errno != errno.EINVAL:  # else the directory names a place before the file's beginning
            raise
        advance(-written)
        raise DamagedError(str(error)) from error
    except (NotImplementedError, RuntimeError) as error:
        raise InputError(f"{member.info.filename} is packed in a way that cannot be read here ({error})") from error
