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
import math
from collections.abc import Collection, Mapping
from dataclasses import fields, replace
from functools import cache, partial
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated, Any

import numpy as np
from annotated_types import Len
from pydantic_core import from_json

from gsbench.errors import InputError
from gsbench.files import GIT_LFS, LFS_REMEDY
from gsbench.parsing import (
    DamagedError,
    Number,
    Record,
    Text,
    parse_typed,
    read_bytes,
    resolved,
    table_beside,
    text_of,
)
from gsbench.scene.colmap_files import require_subfolder
from gsbench.scene.hold_out import resolve, split_names
from gsbench.scene.images import image_size, list_images
from gsbench.scene.names import IMAGE_SUFFIXES, match
from gsbench.scene.options import Backdrop, require_enough
from gsbench.scene.record import AppliedTransform, Photograph, PointsFile, RawCapture, Role
from gsbench.scene.rules import Finding, given
from gsbench.scene.types import ROTATION_TOLERANCE, Array, CameraModel, nearest_rotation
from gsbench.words import counted, some_of

log = logging.getLogger(__name__)

ONE_FILE = "transforms.json"
# of the one file and of a Blender scene's files, transforms_train.json and so on
ROLES: dict[str, Role] = {"": "", "train": "train", "test": "test", "val": "test"}
Row = Annotated[list[Number], Len(4, 4)]
Optional = Number | None
Matrix = Annotated[list[Row], Len(3, 4)]  # a fourth row must be `LAST_ROW`
LAST_ROW = [0.0, 0.0, 0.0, 1.0]
OPENGL = np.diag([1.0, -1.0, -1.0])  # from OpenCV's camera axes to OpenGL's, and back
FISHEYE = "OPENCV_FISHEYE"
RATIONAL = "FULL_OPENCV"  # OpenCV's: a polynomial of k1, k2, k3 divided by one of k4, k5, k6
KEYS = table_beside(__file__, "transforms_keys.yaml")
MODELS = KEYS["coefficients"]
# A principal point may be the centre of a copy of another size if it is off by one factor along
# both sides, up to a tenth.
SAME_SCALE = 0.1


def find_files(folder: Path) -> dict[str, Path]:
    """The one file of a folder, under the key "", or the files of a Blender scene by their split.

    Raises InputError if the folder has neither.
    """
    files = {
        split: path
        for split in ROLES
        if split and (path := folder / f"transforms_{split}.json").is_file()
    }
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
    held_out = record.test_filenames or record.val_filenames
    if not held_out:
        return {}
    lists = [
        None if listed is None else [_place(path, name, image_folder) for name in listed]
        for listed in (record.train_filenames, held_out)
    ]
    names = sorted(images)
    try:
        train, test = split_names(names, *(resolve(listed, names) for listed in lists))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    roles: dict[str, Role] = dict.fromkeys(names, "unused")
    roles |= dict.fromkeys(train, "train")
    return roles | dict.fromkeys(test, "test")


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


# ---- records of the file, and cameras and poses in COLMAP's form


class Intrinsics(Record):
    """Intrinsics of one frame, or of all cameras of a file."""

    camera_model: str | None = None
    is_fisheye: bool | None = None  # instant-ngp's key for OPENCV_FISHEYE
    w: Optional = None
    h: Optional = None
    fl_x: Optional = None
    fl_y: Optional = None
    cx: Optional = None
    cy: Optional = None
    camera_angle_x: Optional = None  # horizontal field of view, radians
    camera_angle_y: Optional = None  # vertical
    x_fov: Optional = None  # the same in degrees: instant-ngp's keys
    y_fov: Optional = None
    k1: Optional = None
    k2: Optional = None
    k3: Optional = None
    k4: Optional = None
    k5: Optional = None
    k6: Optional = None
    p1: Optional = None
    p2: Optional = None


class FrameRecord(Intrinsics):
    """A frame of the file: a photograph with its pose."""

    file_path: Text
    transform_matrix: Matrix
    mask_path: Text | None = None
    depth_file_path: Text | None = None


class TransformsRecord(Intrinsics):
    """The content of ``transforms.json`` before its conversion."""

    frames: list[FrameRecord]
    applied_transform: Matrix | None = None
    applied_scale: Number | None = None
    ply_file_path: Text | None = None
    train_filenames: list[Text] | None = None
    val_filenames: list[Text] | None = None
    test_filenames: list[Text] | None = None


def applied_transform_of(path: Path, record: TransformsRecord) -> AppliedTransform:
    scale = 1.0 if record.applied_scale is None else record.applied_scale
    if not scale > 0:
        raise InputError(f"{path}: applied_scale must be positive, got {scale}")
    if record.applied_transform is None:
        return AppliedTransform(scale=scale)
    return AppliedTransform(_rigid(record.applied_transform, f"{path}: applied_transform"), scale)


def _rigid(matrix: Matrix, what: str) -> Array:
    """The nearest rotation and the translation [3, 4].

    Raises InputError if a fourth row is not `LAST_ROW`, or the matrix does not only rotate.
    """
    if matrix[3:] and not np.allclose(matrix[3], LAST_ROW, atol=ROTATION_TOLERANCE):
        raise InputError(f"{what} must end with the row 0, 0, 0, 1: transpose it if it has columns")
    rows: Array = np.array(matrix[:3])
    rows[:, :3] = nearest_rotation(rows[:, :3], what)
    return rows


def pose_of(path: Path, frame: FrameRecord, applied: AppliedTransform) -> tuple[Array, Array]:
    saved = _rigid(frame.transform_matrix, f"{path}: transform_matrix of {frame.file_path}")
    rotation = (applied.matrix[:, :3].T @ saved[:, :3] @ OPENGL).T
    return rotation, -rotation @ applied.undo(saved[None, :, 3])[0]


def intrinsics_of(record: TransformsRecord, frame: FrameRecord) -> dict[str, Any]:
    """A frame's own intrinsics, else the file's.

    Focal lengths come from one of both, and so do coefficients: never a mix.
    """
    found: dict[str, Any] = {}
    for keys in KEYS["used_together"]:
        source = frame if any(getattr(frame, key) is not None for key in keys) else record
        found |= {key: getattr(source, key) for key in keys}
    return found


def camera_of(
    image: Path, path: Path, record: TransformsRecord, frame: FrameRecord
) -> tuple[CameraModel, list[Finding]]:
    """The camera of a frame, and its focal lengths over those that its fields of view mean."""
    where, known = f"{path}: {frame.file_path}", intrinsics_of(record, frame)
    _check_own_size(where, record, frame)
    width, height, cx, cy = (known[key] for key in ("w", "h", "cx", "cy"))
    if width is None or height is None:
        width, height = image_size(image)
        _check_center(where, width, height, cx, cy)
    if width != int(width) or height != int(height) or min(width, height) < 1:
        raise InputError(f"{where}: w and h must be whole numbers of px, got {width} and {height}")
    focals, compared = [], []
    for side, axis in ((width, "x"), (height, "y")):
        written, degrees = known[f"fl_{axis}"], known[f"{axis}_fov"]
        angle = known[f"camera_angle_{axis}"]
        if angle is None and degrees is not None:
            angle = math.radians(degrees)
        meant = written
        if angle is not None:
            meant = side / (2 * math.tan(angle / 2)) if 0 < angle < math.pi else 0.0
            if written and meant:
                facts = {"given": written, "meant": meant}
                compared.append(Finding(written / meant, [frame.file_path], facts))
        focals.append(meant if written is None else written)
    # Pixels are square if only one of both is given, as in instant-ngp and nerfstudio.
    found = [focal for focal in focals if focal is not None]
    if not found or min(found) <= 0.0:
        raise InputError(
            f"{where}: no focal length: fl_x, camera_angle_x (between 0 and pi) or x_fov (between "
            "0 and 180) must be given, or the same for y"
        )
    center = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    model, distortion = _distortion(where, known)
    params = found[0], found[-1], *center, *distortion
    return CameraModel(model, int(width), int(height), params), compared


def _check_own_size(where: str, record: TransformsRecord, frame: FrameRecord) -> None:
    """Raise InputError if the file's intrinsics in px belong to another size than the frame's."""
    sizes = [(frame.w, record.w), (frame.h, record.h)]
    is_other = any(None not in pair and pair[0] != pair[1] for pair in sizes)
    borrowed = [
        key
        for key in ("fl_x", "fl_y", "cx", "cy")
        if getattr(frame, key) is None and getattr(record, key) is not None
    ]
    if is_other and borrowed:
        raise InputError(
            f"{where}: it has another size (w, h) than the file, whose {', '.join(borrowed)} are "
            "px of the file's size: give the frame its own"
        )


def _check_center(
    where: str, width: float, height: float, cx: float | None, cy: float | None
) -> None:
    """Raise InputError if the principal point is the centre of a copy of another size."""
    if cx is None or cy is None or min(cx, cy) <= 0:
        return
    across, down = 2 * cx / width, 2 * cy / height  # 1 at the centre
    if abs(math.log(across / down)) <= math.log(1 + SAME_SCALE):
        rule = "principal-point-of-other-size"
        given(rule, across, where, cx=cx, cy=cy, width=width, height=height)


def _distortion(where: str, intrinsics: Mapping[str, Any]) -> tuple[str, tuple[float, ...]]:
    """COLMAP's name of the camera model, and its parameters after the principal point."""
    given = {name: intrinsics[name] or 0.0 for name in MODELS[RATIONAL]}
    model = intrinsics["camera_model"] or (FISHEYE if intrinsics["is_fisheye"] else "OPENCV")
    if model not in MODELS:
        raise InputError(f"{where}: camera_model {model} is not known here ({', '.join(MODELS)})")
    if MODELS[model] == MODELS["OPENCV"]:
        # k4 is a coefficient of r^8 in nerfstudio and Metashape, but a divisor in OpenCV; only
        # RATIONAL says which.
        needs_k3 = given["k3"] and not any(given[name] for name in ("k4", "k5", "k6"))
        model = RATIONAL if needs_k3 else "OPENCV"
    if unread := [name for name in given if given[name] and name not in MODELS[model]]:
        raise InputError(
            f"{where}: {', '.join(unread)} must be 0 with {model}; of the models that are read, "
            f"only {FISHEYE} has k4, and {RATIONAL} has k4, k5 and k6: make a COLMAP model"
        )
    params = tuple(given[name] for name in MODELS[model])
    return (model, params) if any(params) or model != "OPENCV" else ("PINHOLE", ())
