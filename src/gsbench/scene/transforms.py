"""Reading ``transforms.json`` of nerfstudio, instant-ngp and Blender into COLMAP's form.

A ``transform_matrix`` maps camera coordinates to world coordinates, in OpenGL axes (x right, y up,
looking along -z). Intrinsics have COLMAP's meaning. ``applied_transform`` and ``applied_scale``
were applied to the original data: ``saved = applied_scale * applied_transform(original)``. Both are
undone for cameras and points, so that lengths are those of the original data. Sources: nerfstudio's
page "Data conventions" and its reader of this format (nerfstudio_dataparser.py), the Blender scenes
of NeRF (Mildenhall et al. 2020).
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from pydantic_core import from_json

from gsbench.errors import InputError
from gsbench.parsing import (
    DamagedError,
    parse_typed,
    read_bytes,
    resolved,
    text_of,
)
from gsbench.scene.images import IMAGE_SUFFIXES, list_images, match_names, stem_of
from gsbench.scene.options import Backdrop
from gsbench.scene.transforms_cameras import (
    AppliedTransform,
    FrameRecord,
    PosedCamera,
    TransformsRecord,
    applied_transform_of,
    camera_of,
    pose_of,
    report_contradictions,
)
from gsbench.scene.transforms_keys import check_keys
from gsbench.words import some_of

log = logging.getLogger(__name__)

ONE_FILE = "transforms.json"
SPLIT_FILES = {
    "train": "transforms_train.json",
    "test": "transforms_test.json",
    "val": "transforms_val.json",
}


@dataclass(frozen=True)
class Transforms:
    """Converted content of a folder's files: cameras by image name, their split, and their points.

    ``split`` are the names for training and for testing, or None if one file holds all images.
    ``points`` is a PLY file; ``applied_to_points.undo`` converts its coordinates to those of the
    cameras. ``has_mask_paths`` says that at least one image names a mask. ``missing`` are the
    images without a file, and ``remedy`` says where files with such names lie.
    """

    files: tuple[Path, ...]
    images: dict[str, PosedCamera]
    split: tuple[list[str], list[str]] | None
    points: Path | None
    applied_to_points: AppliedTransform
    has_mask_paths: bool
    missing: tuple[str, ...] = ()
    remedy: str = ""

    @property
    def sources(self) -> tuple[Path, ...]:
        """The files that cameras and points are read from."""
        return (*self.files, *(() if self.points is None else (self.points,)))


def find_files(folder: Path) -> dict[str, Path]:
    """The one file of a folder, under the key "", or the files of a Blender scene by their split.

    Raises InputError if the folder has neither.
    """
    files = {
        split: folder / name for split, name in SPLIT_FILES.items() if (folder / name).is_file()
    }
    if (folder / ONE_FILE).is_file():
        if files:
            others = ", ".join(path.name for path in files.values())
            log.warning("%s is read, and %s not: move one away", folder / ONE_FILE, others)
        return {"": folder / ONE_FILE}
    if "train" not in files:
        raise InputError(
            f"{folder}: neither {ONE_FILE} nor {SPLIT_FILES['train']} is here: give the folder "
            "that holds it, or take scene=colmap or scene=photos"
        )
    if "test" in files:
        # published results on Blender's scenes use only the training and test views
        files.pop("val", None)
    return files


def read_transforms(
    folder: Path, backdrop: Backdrop = "black", image_folder: str | None = None
) -> Transforms:
    """Read the cameras in ``folder``; raises InputError for a file that cannot be understood.

    ``backdrop`` is the colour under transparent pixels. ``image_folder`` replaces the folder that
    the files name, as nerfstudio replaces ``images`` by ``images_4``: ``images_4/a.png`` is read
    for ``images/a.png``.
    """
    files = find_files(folder)
    records = {split: _read_record(path, backdrop) for split, path in files.items()}
    find = _FileFinder(folder, image_folder)
    images: dict[str, PosedCamera] = {}
    names: dict[str, list[str]] = {split: [] for split in files}
    points, applied_to_points = None, AppliedTransform()
    all_missing: list[str] = []
    for split, record in records.items():
        path, missing = files[split], []
        applied = applied_transform_of(path, record)
        for frame in record.frames:
            name = find(path, frame.file_path)
            if name is None:
                missing.append(frame.file_path)
                continue
            if name in images:
                raise InputError(f"{path}: {name} is there twice: name each image once")
            camera = camera_of(folder / name, path, record, frame)
            if not names[split]:
                report_contradictions(path, record, camera)
            images[name] = camera, *pose_of(path, frame, applied)
            names[split].append(name)
        if missing:
            share = f"{len(missing)} of {len(record.frames)}"
            log.warning("%s: %s images have no file: %s", path, share, some_of(missing))
            all_missing += missing
        if record.ply_file_path is not None:
            named = folder / _relative_path(path, record.ply_file_path)
            if points not in (None, named):
                raise InputError(f"{path} names other points than another file: keep one of them")
            # They lie in one place, so only one of two transforms can be theirs.
            if points is not None and not applied.equals(applied_to_points):
                raise InputError(
                    f"{path} names the same points as another file, whose applied_transform or "
                    "applied_scale differs: keep ply_file_path in the file that they belong to"
                )
            points, applied_to_points = named, applied
            if not points.is_file():
                raise InputError(f"{path} names {record.ply_file_path}, which is not there")
    own_lists = _named_split(files[""], records[""], images, find) if "" in files else None
    held_out = next((sorted(names[split]) for split in ("test", "val") if split in files), None)
    return Transforms(
        tuple(files.values()),
        dict(sorted(images.items())),
        own_lists if held_out is None else (sorted(names["train"]), held_out),
        points,
        applied_to_points,
        any(frame.mask_path for record in records.values() for frame in record.frames),
        tuple(all_missing),
        find.remedy(all_missing),
    )


def _relative_path(path: Path, written: str) -> PurePosixPath:
    """The path ``written`` in a file; raises InputError if it leads out of the file's folder."""
    relative = PurePosixPath(written.replace("\\", "/"))
    if relative.is_absolute() or ".." in relative.parts or PureWindowsPath(written).drive:
        raise InputError(
            f"{path}: {written} lies outside the folder of the file: name images relative to it"
        )
    return relative


def _read_record(path: Path, backdrop: Backdrop) -> TransformsRecord:
    content = read_bytes(resolved(path))
    try:
        content = text_of(content).encode()
    except InputError as error:
        raise DamagedError(path, f"cannot be read: {error}") from error
    record = parse_typed(content, TransformsRecord, path)
    check_keys(
        path, from_json(content), names_of(TransformsRecord), names_of(FrameRecord), backdrop
    )
    return record


def names_of(kind: Any) -> frozenset[str]:
    """The keys of a record, which gsbench uses."""
    return frozenset(field.name for field in fields(kind))


class _FileFinder:
    """Finds the image that ``file_path`` names, as for COLMAP models (`match_names`)."""

    def __init__(self, folder: Path, image_folder: str | None = None) -> None:
        self.folder, self.image_folder = folder, image_folder

    @cached_property
    def _files(self) -> list[str]:
        return list_images(self.folder)

    def place(self, path: Path, written: str) -> PurePosixPath:
        """The path of an image as the file writes it, or in the folder that is read instead."""
        relative = _relative_path(path, written)
        if self.image_folder is None:
            return relative
        return PurePosixPath(self.image_folder, *(relative.parts[1:] or relative.parts))

    def __call__(self, path: Path, written: str) -> str | None:
        """The name below the folder, or None if no file fits. Blender writes no extension."""
        relative = self.place(path, written)
        if relative.suffix.lower() in IMAGE_SUFFIXES and (self.folder / relative).is_file():
            return relative.as_posix()
        try:
            return match_names([relative.as_posix()], self._files).get(relative.as_posix())
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    def remedy(self, missing: Collection[str]) -> str:
        """Advice, if one folder has files with the last parts of the ``missing`` names; else ""."""
        wanted = {stem_of(PurePosixPath(name).name).casefold() for name in missing}
        folders = Counter(
            file.rpartition("/")[0]
            for file in (self._files if wanted else ())
            if stem_of(PurePosixPath(file).name).casefold() in wanted
        )
        if not folders:
            return ""
        folder, count = folders.most_common(1)[0]
        return f"{folder or '.'} has {count} of the names: set scene.images={folder or '.'}"


def _named_split(
    path: Path, record: TransformsRecord, images: Collection[str], find: _FileFinder
) -> tuple[list[str], list[str]] | None:
    """nerfstudio's lists: names to train on, and to test on or, without these, to validate on."""
    train, val, test = record.train_filenames, record.val_filenames, record.test_filenames
    held_out = test or val
    if not held_out:
        return None
    written = {"train": train or [], "held-out": held_out}
    chosen = {}
    for which, listed in written.items():
        wanted = [find.place(path, name).as_posix() for name in listed]
        matches = match_names(wanted, images)
        if missing := [name for name in wanted if name not in matches]:
            raise InputError(
                f"{path}: its {which} filenames name {some_of(missing)}, which is no frame with a "
                "file"
            )
        chosen[which] = set(matches.values())
    if both := sorted(chosen["train"] & chosen["held-out"]):
        raise InputError(
            f"{path}: {some_of(both)} would be trained and tested on: correct its lists of "
            "filenames"
        )
    kept = chosen["train"] if train is not None else set(images) - chosen["held-out"]
    return sorted(kept), sorted(chosen["held-out"])
