"""Bringing scenes here: what is missing comes out of the archive, is checked, and appears when it is complete."""

from __future__ import annotations

import logging
import shutil
import time
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from gsbench.datasets.archive import (
    DamagedError,
    Member,
    RangesRefusedError,
    extract,
    holds,
    members_of,
    open_archive,
    open_local,
    open_remote,
)
from gsbench.datasets.catalog import DATA_VARIABLE, Archive, SceneFiles
from gsbench.datasets.records import RECORDS, FileRecord, SceneRecord, add_record, read_records
from gsbench.downloads import FetchError, Patience, download, retried
from gsbench.errors import InputError
from gsbench.files import atomic, file_sha256
from gsbench.logs import Progress
from gsbench.words import counted, readable_bytes, some_of

log = logging.getLogger(__name__)

STAGING = ".fetch"  # below the data folder: what has come so far
SPARE_BYTES = 1 << 26  # that a fetch leaves free on the disk


@dataclass(frozen=True)
class ScenePlan:
    """A scene against its archive: its members, and those that neither its folder nor the staging has yet."""

    files: SceneFiles
    members: tuple[Member, ...]
    missing: tuple[Member, ...]
    staged: tuple[Member, ...]

    @property
    def bytes(self) -> int:
        return sum(member.bytes for member in self.members)

    @property
    def missing_bytes(self) -> int:
        return sum(member.bytes for member in self.missing)


@dataclass(frozen=True)
class Fetcher:
    """Fetches scenes of archives into the folder ``data``; the caller holds its lock.

    ``mirror`` is another place of the archives: the start of an address, or a folder on this machine.
    ``accept_changes`` takes what differs from the records of an earlier fetch as the new record.
    """

    data: Path
    mirror: str | None
    patience: Patience
    accept_changes: bool
    report: Progress  # in bytes

    def record_if_here(self, files: SceneFiles) -> SceneRecord | None:
        """The record of a fetch whose files all lie in the scene's folder, as they were recorded; else None."""
        record, folder = read_records(self.data).get(files.key), self.data / files.folder
        if record is None or self.accept_changes:
            return None
        here = all(holds(folder / name, file.size, file.crc) for name, file in record.files.items())
        return record if here else None

    def plan(self, archive: Archive, scenes: Sequence[SceneFiles]) -> list[ScenePlan]:
        """Plan a fetch; reads only the archive's directory. Raises `RangesRefusedError` where it cannot be read."""
        with self._opened(archive, may_fetch_whole=False) as opened:
            return [self._plan(archive, opened, files) for files in scenes]

    def fetch(self, archive: Archive, scenes: Sequence[SceneFiles]) -> Iterator[str]:
        """Fetch the scenes, one after another; yields a line about each."""
        with self._opened(archive) as opened:
            plans = [self._plan(archive, opened, files) for files in scenes]
            self._require_space(sum(plan.missing_bytes for plan in plans))
            for plan in plans:
                self._extract_missing(archive, opened, plan)
                yield self._publish(plan, archive)

    def _location(self, archive: Archive) -> str:
        """The address of the archive, or its path on this machine."""
        return archive.url if self.mirror is None else f"{self.mirror.rstrip('/')}/{archive.name}"

    def _staging(self, files: SceneFiles) -> Path:
        return self.data / STAGING / files.scene

    @contextmanager
    def _opened(self, archive: Archive, may_fetch_whole: bool = True) -> Iterator[zipfile.ZipFile]:
        """The archive: on this machine, on its server, or the whole of it where the server serves no ranges."""
        where = self._location(archive)
        if "://" not in where:
            with open_local(Path(where).expanduser()) as opened:
                yield opened
            return
        try:
            with open_remote(where, self.patience) as opened:
                yield opened
        except RangesRefusedError:
            if not may_fetch_whole:
                raise
        else:
            return
        whole = self.data / STAGING / archive.name
        if not whole.is_file():  # else an earlier fetch was stopped after it
            self._download(archive, where, whole)
        try:
            with open_local(whole) as opened:
                yield opened
        except FetchError:
            whole.unlink()  # a member of it is damaged
            raise
        whole.unlink()

    def _download(self, archive: Archive, where: str, whole: Path) -> None:
        log.info("%s: the server serves no ranges: the whole archive comes", where)
        self._require_space(archive.bytes or 0)
        whole.parent.mkdir(parents=True, exist_ok=True)
        with atomic(whole) as temporary:
            sha256 = download(
                where, temporary, self.patience, lambda done, total: self.report(archive.name, done, total)
            )
            pinned = archive.sha256.get("archive")
            if pinned not in (None, sha256):
                raise InputError(f"{where} has sha256 {sha256}, not {pinned}: give another --mirror")
            with temporary.open("rb") as file:
                open_archive(file, where).close()

    def _plan(self, archive: Archive, opened: zipfile.ZipFile, files: SceneFiles) -> ScenePlan:
        """Sort the scene's members by where they are.

        Raises `InputError` where the archive has others than an earlier fetch recorded, or the scene's folder holds
        other files of their names.
        """
        where, target = self._location(archive), self.data / files.folder
        members = members_of(opened, archive.scenes[files.scene], files.parts, where)
        record = read_records(self.data).get(files.key)
        if record is not None and not self.accept_changes:
            recorded = {name: (file.size, file.crc) for name, file in record.files.items()}
            offered = {member.name: (member.bytes, member.info.CRC) for member in members}
            changed = sorted(name for name in recorded | offered if recorded.get(name) != offered.get(name))
            if changed:
                raise InputError(
                    f"{where}: {counted(len(changed), 'file')} of {files.scene} differ from what was fetched on "
                    f"{record.date} ({some_of(changed)}): give another --mirror, or --accept-changes"
                )
        staged, missing, other = [], [], []
        for member in members:
            if holds(target / member.name, member.bytes, member.info.CRC):
                continue
            if (target / member.name).exists():
                other.append(member.name)
            elif holds(self._staging(files) / member.name, member.bytes, member.info.CRC):
                staged.append(member)
            else:
                missing.append(member)
        if other:
            raise InputError(
                f"{target}: {counted(len(other), 'file')} there differ from the archive's ({some_of(other)}): move "
                "this folder away, and the same command fetches it"
            )
        return ScenePlan(files, tuple(members), tuple(missing), tuple(staged))

    def _extract_missing(self, archive: Archive, opened: zipfile.ZipFile, plan: ScenePlan) -> None:
        """Extract what is missing into the staging folder."""
        where, done = self._location(archive), 0

        def advance(count: int) -> None:
            nonlocal done
            done += count
            self.report(plan.files.scene, done, plan.missing_bytes)

        for member in sorted(plan.missing, key=lambda member: member.info.header_offset):
            target = self._staging(plan.files) / member.name
            for is_last_try in (False, True):  # of damage on the way; a cut connection is tried again within
                try:
                    retried(lambda: extract(opened, member, target, advance), where, self.patience)  # noqa: B023
                    break
                except DamagedError as error:
                    if is_last_try:
                        raise FetchError(
                            f"{where}: {member.info.filename} arrives damaged ({error}): try again later, or give "
                            "another address with --mirror"
                        ) from error

    def _publish(self, plan: ScenePlan, archive: Archive) -> str:
        """Move what was staged to where the scene file looks for it, and record it; returns a line about it."""
        files, staging, target = plan.files, self._staging(plan.files), self.data / plan.files.folder
        names = {member.name for member in plan.members}
        for path in [path for path in staging.rglob("*") if path.is_file()]:
            if path.relative_to(staging).as_posix() not in names:
                path.unlink()  # of an earlier fetch that wanted something else
        places = {name: target if (target / name).exists() else staging for name in names}
        record = SceneRecord(
            url=self._location(archive),
            date=time.strftime("%Y-%m-%d", time.gmtime()),
            files={
                m.name: FileRecord(size=m.bytes, crc=m.info.CRC, sha256=file_sha256(places[m.name] / m.name))
                for m in plan.members
            },
        )
        known = read_records(self.data).get(files.key)
        try:
            verdict = self._compare(files, record, known, archive.sha256.get(files.key))
        except InputError:
            shutil.rmtree(staging, ignore_errors=True)  # else it would be taken up again
            raise
        for part in files.parts:
            if not (staging / part).is_dir():
                continue
            moved = [part]  # at once, so that no folder of images is ever half there
            if (target / part).exists():
                moved = sorted(name for name in names if name.startswith(f"{part}/") and places[name] is staging)
            for name in moved:
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.move(staging / name, target / name)
        shutil.rmtree(staging, ignore_errors=True)
        if known is None or known.sha256 != record.sha256:
            add_record(self.data, files.key, record)
        came = sum(member.bytes for member in (*plan.missing, *plan.staged))
        news = f"{readable_bytes(came)} fetched" if came else "was there, as in the archive"
        return f"{files.scene}: {describe(self.data, files, record)}: {news}; {verdict}"

    def _compare(self, files: SceneFiles, new: SceneRecord, known: SceneRecord | None, pinned: str | None) -> str:
        """Words on the checksums; raises `InputError` where they are not those that are expected."""
        if pinned is not None:
            if new.sha256 != pinned:
                raise InputError(
                    f"{files.scene}: sha256 {new.sha256}, but {pinned} is published: give another --mirror"
                )
            return f"sha256 {new.sha256} as published"
        if known is None or (self.accept_changes and known.sha256 != new.sha256):
            return f"sha256 {new.sha256} recorded in {RECORDS} (none is published), later fetches must agree"
        if known.sha256 != new.sha256:
            changed = [name for name, file in new.files.items() if known.files.get(name) != file]
            raise InputError(
                f"{files.scene}: {some_of(changed)} have another sha256 than on {known.date}, though the same CRC-32: "
                "give another --mirror, or --accept-changes"
            )
        return f"sha256 as recorded on {known.date}"

    def _require_space(self, needed: int) -> None:
        place = next(folder for folder in (self.data, *self.data.absolute().parents) if folder.exists())
        free = shutil.disk_usage(place).free
        if needed and needed + SPARE_BYTES > free:
            raise InputError(
                f"{readable_bytes(needed)} are to be fetched into {self.data}, where {readable_bytes(free)} are free: "
                f"free some space, or set {DATA_VARIABLE} to a folder on another disk"
            )


def describe(data: Path, files: SceneFiles, record: SceneRecord) -> str:
    """Describe in words what a record holds."""
    size = f"{counted(len(record.files), 'file')}, {readable_bytes(record.bytes)}"
    return f"{size} in {data / files.folder} ({', '.join(files.parts)})"
