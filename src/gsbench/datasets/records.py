"""Records of what was fetched into a data folder, with checksums: written at the first fetch, compared at later ones.

``<data>/fetched.json`` holds for every scene and set of folders the size, CRC-32 and sha256 of each file. Nobody
publishes checksums of these archives' members, so the first fetch decides what later ones must be equal to.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from gsbench.errors import InputError
from gsbench.files import write_json
from gsbench.parsing import DamagedError
from gsbench.records import Count, Part, Text, read_typed

RECORDS = "fetched.json"


@dataclass(frozen=True, kw_only=True)
class FileRecord(Part):
    """One file: bytes, CRC-32, and sha256 in hexadecimal."""

    size: Count
    crc: Count
    sha256: Text


@dataclass(frozen=True, kw_only=True)
class SceneRecord(Part):
    """Record of a fetch of a scene: its source, its day, and its files by name below the scene's folder."""

    url: Text
    date: Text
    files: Mapping[str, FileRecord]

    @property
    def bytes(self) -> int:
        return sum(file.size for file in self.files.values())

    @property
    def sha256(self) -> str:
        """One checksum for all: the sha256 of sha256sum's lines ``<sha256>  <name>``, sorted by name."""
        lines = (f"{file.sha256}  {name}\n" for name, file in sorted(self.files.items()))
        return hashlib.sha256("".join(lines).encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class Fetched(Part):
    """The file of a data folder: its scenes by `gsbench.datasets.catalog.SceneFiles.key`."""

    scenes: dict[str, SceneRecord] = field(default_factory=dict)


def read_records(data: Path) -> dict[str, SceneRecord]:
    """Read the records of a data folder; {} without any. Raises `InputError` where the file cannot be read."""
    file = data / RECORDS
    try:
        return read_typed(file, Fetched).scenes
    except FileNotFoundError:
        return {}
    except (OSError, DamagedError) as error:
        raise InputError(f"{error}: delete {file}, and the next fetch records anew") from error


def add_record(data: Path, key: str, record: SceneRecord) -> None:
    """Write a record into the data folder's file; the caller holds the folder's lock."""
    write_json(data / RECORDS, Fetched(scenes=read_records(data) | {key: record}).to_json())
