"""Files that a scene needs of its archive, and those of them that are here already."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from gsbench.datasets.archive import Member, holds
from gsbench.datasets.catalog import DATA_VARIABLE
from gsbench.datasets.records import SceneRecord, record_key
from gsbench.errors import InputError
from gsbench.system.install import conf_dir
from gsbench.words import counted, readable_bytes, some_of

SCENE_PATH = re.compile(r"\$\{oc\.env:GSBENCH_DATA,data\}/(?P<folder>.+)")


@dataclass(frozen=True)
class SceneFiles:
    """Files that conf/scene/<scene>.yaml asks for: its folder below the data folder, and the folders in it."""

    scene: str
    folder: str
    parts: tuple[str, ...]  # images before the model: a model alone is no scene

    @property
    def key(self) -> str:
        return record_key(self.scene, self.parts)


def wanted_files(scene: str, images: str | None = None) -> SceneFiles:
    """The files that a scene file asks for; ``images`` names another image folder than it does."""
    settings = yaml.safe_load((conf_dir() / "scene" / f"{scene}.yaml").read_text(encoding="utf-8"))
    match = SCENE_PATH.fullmatch(settings["path"])
    if match is None:
        raise InputError(f"conf/scene/{scene}.yaml does not lie below ${DATA_VARIABLE}: it cannot be fetched")
    parts = (images or settings.get("images") or "images", settings.get("sparse") or "sparse/0")
    return SceneFiles(scene, match["folder"], parts)


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

    @property
    def fetched_bytes(self) -> int:
        """The bytes that this fetch and those that were stopped bring."""
        return self.missing_bytes + sum(member.bytes for member in self.staged)


def check_unchanged(files: SceneFiles, members: Sequence[Member], record: SceneRecord, where: str) -> None:
    """Raise `InputError` unless the archive's directory has the files that an earlier fetch recorded."""
    recorded = {name: (file.size, file.crc) for name, file in record.files.items()}
    offered = {member.name: (member.bytes, member.info.CRC) for member in members}
    changed = sorted(name for name in recorded | offered if recorded.get(name) != offered.get(name))
    if changed:
        raise InputError(
            f"{where}: {counted(len(changed), 'file')} of {files.scene} differ from what was fetched on {record.date} "
            f"({some_of(changed)}): give another --mirror, or --accept-changes"
        )


def plan_scene(files: SceneFiles, members: Sequence[Member], target: Path, staging: Path) -> ScenePlan:
    """Sort the members by where they are; raises `InputError` where the scene's folder holds others of their names."""
    staged, missing, other = [], [], []
    for member in members:
        if holds(target / member.name, member.bytes, member.info.CRC):
            continue
        if (target / member.name).exists():
            other.append(member.name)
        elif holds(staging / member.name, member.bytes, member.info.CRC):
            staged.append(member)
        else:
            missing.append(member)
    if other:
        raise InputError(
            f"{target}: {counted(len(other), 'file')} there differ from the archive's ({some_of(other)}): move this "
            "folder away, and the same command fetches it"
        )
    return ScenePlan(files, tuple(members), tuple(missing), tuple(staged))


def describe(data: Path, files: SceneFiles, record: SceneRecord) -> str:
    """Describe in words what a record holds."""
    size = f"{counted(len(record.files), 'file')}, {readable_bytes(record.bytes)}"
    return f"{size} in {data / files.folder} ({', '.join(files.parts)})"
