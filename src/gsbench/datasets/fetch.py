"""Bringing a scene here: what is missing comes out of its archive, is checked, and appears when it is complete."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

from gsbench.datasets.archive import DamagedError, extract, holds, members_of
from gsbench.datasets.catalog import SceneFiles
from gsbench.downloads import FetchError, Patience, retried
from gsbench.logs import Progress
from gsbench.words import counted, readable_bytes

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
