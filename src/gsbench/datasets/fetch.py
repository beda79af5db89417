"""Bringing scenes here: what is missing comes out of the archive, is checked, and appears when it is complete."""

from __future__ import annotations

import logging
import shutil
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from gsbench.datasets.archive import DamagedError, extract, holds, members_of, open_archive, runs_of
from gsbench.datasets.catalog import DATA_VARIABLE, Archive
from gsbench.datasets.plan import SceneFiles, ScenePlan, check_unchanged, describe, plan_scene
from gsbench.datasets.records import RECORDS, FileRecord, SceneRecord, add_record, read_records, today
from gsbench.datasets.remote import FetchError, Patience, RangesRefusedError, RemoteFile, download, size_of
from gsbench.errors import InputError
from gsbench.files import atomic, file_sha256, require_regular
from gsbench.logs import Progress
from gsbench.words import readable_bytes, some_of

log = logging.getLogger(__name__)

STAGING = ".fetch"  # below the data folder: what has come so far
ATTEMPTS = 2  # at a member that arrives damaged
SPARE_BYTES = 1 << 26  # that a fetch leaves free on the disk


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
        if record is None:
            return None
        here = all(holds(folder / name, file.size, file.crc) for name, file in record.files.items())
        return record if here else None

    def location_of(self, archive: Archive) -> str:
        """The address of the archive, or its path on this machine."""
        return archive.url if self.mirror is None else f"{self.mirror.rstrip('/')}/{archive.name}"

    def plan(self, archive: Archive, scenes: Sequence[SceneFiles]) -> list[ScenePlan]:
        """Plan a fetch; reads only the archive's directory. Raises `RangesRefusedError` where it cannot be read."""
        with self._opened(archive, may_fetch_whole=False) as (opened, _):
            return [self._plan(archive, opened, files) for files in scenes]

    def fetch(self, archive: Archive, scenes: Sequence[SceneFiles]) -> Iterator[str]:
        """Fetch the scenes, one after another; yields a line about each."""
        with self._opened(archive) as (opened, remote):
            plans = [self._plan(archive, opened, files) for files in scenes]
            self._require_space(sum(plan.missing_bytes for plan in plans))
            for plan in plans:
                self._bring(archive, opened, remote, plan)
                yield self._publish(plan, archive)

    @contextmanager
    def _opened(
        self, archive: Archive, may_fetch_whole: bool = True
    ) -> Iterator[tuple[zipfile.ZipFile, RemoteFile | None]]:
        where = self.location_of(archive)
        if "://" not in where:
            require_regular(Path(where).expanduser())
            try:
                file = Path(where).expanduser().open("rb")
            except OSError as error:
                raise InputError(f"{where} cannot be read ({error.strerror}): mend --mirror") from error
            with file, open_archive(file, where) as opened:
                yield opened, None
            return
        try:
            remote = RemoteFile(where, self.patience)
        except RangesRefusedError:
            if not may_fetch_whole:
                raise
            with self._whole(archive, where).open("rb") as file, open_archive(file, where) as opened:
                yield opened, None
            self._whole_path(archive).unlink()
        else:
            with remote, open_archive(remote, where) as opened:  # type: ignore[arg-type]  # a RawIOBase reads bytes
                yield opened, remote

    def _whole(self, archive: Archive, where: str) -> Path:
        """The whole archive in the staging folder; one that an earlier fetch left there is used again."""
        target = self._whole_path(archive)
        size = size_of(where, self.patience)
        if target.is_file() and target.stat().st_size == size:
            return target
        log.info("%s: the server serves no ranges: the whole archive comes (%s)", where, readable_bytes(size))
        self._require_space(size or archive.bytes or 0)
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic(target) as temporary:
            sha256 = download(
                where, temporary, self.patience, lambda done, total: self.report(archive.name, done, total or done)
            )
            pinned = archive.sha256.get("archive")
            if pinned not in (None, sha256):
                raise InputError(f"{where} has sha256 {sha256}, not {pinned}: give another --mirror")
            with temporary.open("rb") as file:
                open_archive(file, where).close()
        return target

    def _plan(self, archive: Archive, opened: zipfile.ZipFile, files: SceneFiles) -> ScenePlan:
        where = self.location_of(archive)
        members = members_of(opened, archive.scenes[files.scene], files.parts, where)
        record = read_records(self.data).get(files.key)
        if record is not None and not self.accept_changes:
            check_unchanged(files, members, record, where)
        return plan_scene(files, members, self.data / files.folder, self._staging(files))

    def _bring(self, archive: Archive, opened: zipfile.ZipFile, remote: RemoteFile | None, plan: ScenePlan) -> None:
        """Extract what is missing into the staging folder."""
        done, total = 0, plan.missing_bytes

        def advance(count: int) -> None:
            nonlocal done
            done += count
            self.report(plan.files.scene, done, total)

        staging = self._staging(plan.files)
        for run, end in runs_of(opened, plan.missing):
            for member in run:
                for attempt in range(1, ATTEMPTS + 1):
                    if remote is not None:
                        remote.expect(end)
                    try:
                        extract(opened, member, staging / member.name, advance)
                        break
                    except DamagedError as error:
                        if attempt == ATTEMPTS:
                            self._whole_path(archive).unlink(missing_ok=True)
                            raise FetchError(
                                f"{self.location_of(archive)}: {member.info.filename} arrives damaged ({error}): try "
                                "again later, or give another address with --mirror"
                            ) from error

    def _publish(self, plan: ScenePlan, archive: Archive) -> str:
        """Move what was staged to where the scene file looks for it, and record it; returns a line about it."""
        files, staging, target = plan.files, self._staging(plan.files), self.data / plan.files.folder
        names = {member.name for member in plan.members}
        for path in [path for path in staging.rglob("*") if path.is_file()]:
            if path.relative_to(staging).as_posix() not in names:
                path.unlink()  # of an earlier fetch that wanted something else
        places = {name: target if (target / name).exists() else staging for name in names}
        sha256 = {name: file_sha256(place / name) for name, place in places.items()}
        known = read_records(self.data).get(files.key)
        record = SceneRecord(
            self.location_of(archive),
            today(),
            {m.name: FileRecord(m.bytes, m.info.CRC, sha256[m.name]) for m in plan.members},
        )
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
        came = plan.fetched_bytes
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

    def _staging(self, files: SceneFiles) -> Path:
        return self.data / STAGING / files.scene

    def _whole_path(self, archive: Archive) -> Path:
        return self.data / STAGING / archive.name

    def _require_space(self, needed: int) -> None:
        place = next(folder for folder in (self.data, *self.data.absolute().parents) if folder.exists())
        free = shutil.disk_usage(place).free
        if needed and needed + SPARE_BYTES > free:
            raise InputError(
                f"{readable_bytes(needed)} are to be fetched into {self.data}, where {readable_bytes(free)} are free: "
                f"free some space, or set {DATA_VARIABLE} to a folder on another disk"
            )
