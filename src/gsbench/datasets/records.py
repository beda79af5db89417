"""Records of what was fetched into a data folder, with checksums: written at the first fetch, compared at later ones.

``<data>/fetched.json`` holds for every scene and set of folders the size, CRC-32 and sha256 of each file. Nobody
publishes checksums of these archives' members, so the first fetch decides what later ones must be equal to.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.files import write_json

RECORDS = "fetched.json"
VERSION = 1


@dataclass(frozen=True)
class FileRecord:
    """One file: bytes, CRC-32, and sha256 in hexadecimal."""

    size: int
    crc: int
    sha256: str


@dataclass(frozen=True)
class SceneRecord:
    """Record of a fetch of a scene: its source, its day, and its files by name below the scene's folder."""

    url: str
    date: str
    files: Mapping[str, FileRecord]

    @property
    def bytes(self) -> int:
        return sum(file.size for file in self.files.values())

    @property
    def sha256(self) -> str:
        """One checksum for all: the sha256 of sha256sum's lines ``<sha256>  <name>``, sorted by name."""
        lines = (f"{file.sha256}  {name}\n" for name, file in sorted(self.files.items()))
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def record_key(scene: str, parts: tuple[str, ...]) -> str:
    """The record's name: a scene with other image folders is another record."""
    return f"{scene}/{'+'.join(parts)}"


def read_records(data: Path) -> dict[str, SceneRecord]:
    """Read the records of a data folder, by `record_key`; {} without any. `InputError` if the file is damaged."""
    file = data / RECORDS
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        return {key: _scene_record(entry) for key, entry in content["scenes"].items()}
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{file} is damaged ({error}): delete it, and the next fetch records anew") from error


def add_record(data: Path, key: str, record: SceneRecord) -> None:
    """Write a record into the data folder's file; the caller holds the folder's lock."""
    scenes = {name: _as_json(known) for name, known in (read_records(data) | {key: record}).items()}
    write_json(data / RECORDS, {"version": VERSION, "scenes": scenes})


def today() -> str:
    return time.strftime("%Y-%m-%d", time.gmtime())


def _scene_record(entry: Any) -> SceneRecord:
    files = {name: FileRecord(int(size), int(crc), str(sha256)) for name, (size, crc, sha256) in entry["files"].items()}
    return SceneRecord(str(entry["url"]), str(entry["date"]), files)


def _as_json(record: SceneRecord) -> dict[str, Any]:
    files = {name: [file.size, file.crc, file.sha256] for name, file in sorted(record.files.items())}
    return {"url": record.url, "date": record.date, "sha256": record.sha256, "files": files}
