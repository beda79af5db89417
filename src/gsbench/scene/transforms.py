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
from collections.abc import Collection
from dataclasses import fields, replace
from functools import cache, partial
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from pydantic_core import from_json

from gsbench.errors import InputError
from gsbench.files import GIT_LFS, LFS_REMEDY
from gsbench.parsing import DamagedError, parse_typed, read_bytes, resolved, text_of
from gsbench.scene.colmap_files import require_subfolder
from gsbench.scene.images import list_images
from gsbench.scene.names import IMAGE_SUFFIXES, match
from gsbench.scene.options import Backdrop, require_enough
from gsbench.scene.record import Photograph, PointsFile, RawCapture, Role
from gsbench.scene.rules import Finding
from gsbench.scene.transforms_cameras import (
    KEYS,
    AppliedTransform,
    FrameRecord,
    TransformsRecord,
    applied_transform_of,
    camera_of,
    pose_of,
)
from gsbench.words import counted, some_of

log = logging.getLogger(__name__)

ONE_FILE = "transforms.json"
# of the one file and of a Blender scene's files, transforms_train.json and so on
ROLES: dict[str, Role] = {"": "", "train": "train", "test": "test", "val": "test"}


def find_files(folder: Path) -> dict[str, Path]:
    """The one file of a folder, under the key "", or the files of a Blender scene by their split.

    Raises InputError if the folder has neither.
    """
    files = {split: folder / f"transforms_{split}.json" for split in ROLES if split}
    files = {split: path for split, path in files.items() if path.is_file()}
    if (folder / ONE_FILE).is_file():
        if files:
            others = ", ".join(path.name for path in files.values())
            log.warning("%s is read, and %s not: move one away", folder / ONE_FILE, others)
        return {"": folder / ONE_FILE}
    if "train" not in files:
        raise InputError(
            f"{folder}: neither {ONE_FILE} nor transforms_train.json is here: give the folder "
            "that holds it, or take scene=colmap or scene=photos"
        )
    if "test" in files:
        # published results on Blender's scenes use only the training and test views
        files.pop("val", None)
    return files


def read_transforms(
    folder: Path, backdrop: Backdrop = "black", image_folder: str | None = None
) -> RawCapture:
    """Read the cameras in ``folder``; raises InputError for a file that cannot be understood.

    ``backdrop`` is the colour under transparent pixels. ``image_folder`` replaces the folder that
    the files name, as nerfstudio replaces ``images`` by ``images_4``: ``images_4/a.png`` is read
    for ``images/a.png``.
    """
    if image_folder is not None:
        require_subfolder(folder, image_folder, "scene.images")
    files = find_files(folder)
    records = {split: _read_record(path, backdrop) for split, path in files.items()}
    listed = cache(partial(list_images, folder))  # not needed if all names are those of files
    rows: dict[str, Photograph] = {}
    points: PointsFile | None = None
    missing: list[str] = []
    ratios: list[Finding] = []
    for split, record in records.items():
        path = files[split]
        applied = applied_transform_of(path, record)
        for frame in record.frames:
            name = _place(path, frame.file_path, image_folder)
            if Path(name).suffix.lower() not in IMAGE_SUFFIXES or not (folder / name).is_file():
                try:  # Blender writes no extension
                    name = match([name], listed()).get(name, "")
                except InputError as error:
                    raise InputError(f"{path}: {error}") from error
            if not name:
                missing.append(frame.file_path)
                continue
            if name in rows:
                raise InputError(f"{path}: {name} is there twice: name each image once")
            camera, compared = camera_of(folder / name, path, record, frame)
            ratios += compared
            rows[name] = Photograph(
                name,
                folder / name,
                camera,
                *pose_of(path, frame, applied),
                mask=_beside(path, frame.mask_path),
                depth=_beside(path, frame.depth_file_path),
                role=ROLES[split] if len(files) > 1 else "",
            )
        points = _points(path, record, applied, points)
    which, mend = f"with a file and a camera in {next(iter(files.values())).name}", ""
    if missing:
        which += f", while {some_of(missing)} have no file"
        mend = "set scene.images to the folder of the photographs"
    require_enough(len(rows), folder, which, mend)
    if "" in files:
        roles = _named_split(files[""], records[""], rows, image_folder)
        rows = {name: replace(row, role=roles.get(name, row.role)) for name, row in rows.items()}
    read_from = *files.values(), *([] if points is None else [points.path])
    ordered = tuple(rows[name] for name in sorted(rows))
    noted = {"no-file": [Finding(len(missing), missing)], "focal-length-and-field": ratios}
    return RawCapture(folder, ordered, points, read_from, noted=noted)


def _beside(path: Path, written: str | None) -> Path | None:
    """The file that a frame names beside its photograph."""
    return None if written is None else path.parent / _relative_path(path, written)


def _points(
    path: Path, record: TransformsRecord, applied: AppliedTransform, known: PointsFile | None
) -> PointsFile | None:
    """The points that the file ``path`` names, or those ``known`` from an earlier one."""
    if record.ply_file_path is None:
        return known
    found = PointsFile(path.parent / _relative_path(path, record.ply_file_path), applied)
    # Points lie in one place, so only one of two transforms can be theirs.
    if known is not None and not (known.path == found.path and known.applied.equals(applied)):
        raise InputError(
            f"{path} names other points than another file, or the same points with another "
            "applied_transform or applied_scale: keep ply_file_path in the file that they belong to"
        )
    if not found.path.is_file():
        raise InputError(f"{path} names {record.ply_file_path}, which is not there")
    return found


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
    if content.startswith(GIT_LFS):
        raise DamagedError(path, f"is {LFS_REMEDY}")
    try:
        content = text_of(content).encode()
    except InputError as error:
        raise DamagedError(path, f"cannot be read: {error}") from error
    record = parse_typed(content, TransformsRecord, path)
    check_keys(path, from_json(content), backdrop)
    return record


def _place(path: Path, written: str, image_folder: str | None) -> str:
    """The path of an image as the file writes it, or in the folder that is read instead."""
    relative = _relative_path(path, written)
    if image_folder is None:
        return relative.as_posix()
    return PurePosixPath(image_folder, *(relative.parts[1:] or relative.parts)).as_posix()


def _named_split(
    path: Path, record: TransformsRecord, images: Collection[str], image_folder: str | None
) -> dict[str, Role]:
    """The roles by nerfstudio's lists: names to train on, and to test or else to validate on."""
    train, held_out = record.train_filenames, record.test_filenames or record.val_filenames
    if not held_out:
        return {}
    chosen: dict[str, set[str]] = {}
    for which, listed in (("train", train or []), ("held-out", held_out)):
        wanted = [_place(path, name, image_folder) for name in listed]
        matches = match(wanted, images)
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
    roles: dict[str, Role] = dict.fromkeys(images, "train" if train is None else "unused")
    roles |= dict.fromkeys(chosen["train"], "train")
    return roles | dict.fromkeys(chosen["held-out"], "test")


def check_keys(path: Path, document: Any, backdrop: Backdrop) -> None:
    """Check the keys of a file that gsbench does not use.

    ``backdrop`` is the colour under transparent pixels. Raises InputError for a refused key whose
    value has an effect (`says_something`). Logs one line that names unknown keys.
    """
    refused = KEYS["refused"] | (KEYS["refused_over_white"] if backdrop == "white" else {})
    known = {*KEYS["harmless"], *refused}
    unknown: set[str] = set()
    frames = [(f" (frame {number})", frame) for number, frame in enumerate(document["frames"])]
    for place, record in [("", document), *frames]:
        used = {entry.name for entry in fields(FrameRecord if place else TransformsRecord)}
        for key, value in record.items():
            if key in refused and says_something(key, value):
                raise InputError(f"{path}: {key}{place}: {refused[key]}")
            if key not in used | known:
                unknown.add(key)
    if unknown:
        are = f"{counted(len(unknown), 'key')} {'is' if len(unknown) == 1 else 'are'}"
        log.warning("%s: %s not known and not used: %s", path, are, ", ".join(sorted(unknown)))


def says_something(key: str, value: Any) -> bool:
    """Return whether a value has an effect: it is not null, false, empty or a list of zeros.

    A matrix has an effect whatever its numbers are.
    """
    if key.startswith("transform_matrix"):
        return value is not None
    if isinstance(value, list):
        return any(says_something(key, item) for item in value)
    return bool(value)
