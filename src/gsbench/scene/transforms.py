"""Reading ``transforms.json`` of nerfstudio, instant-ngp and Blender, and converting its cameras to COLMAP's form.

A ``transform_matrix`` maps camera coordinates to world coordinates, in OpenGL axes (x right, y up, looking along -z).
Intrinsics have COLMAP's meaning. ``applied_transform`` and ``applied_scale`` were applied to the original data:
``saved = applied_scale * applied_transform(original)``. Both are undone for cameras and points, so that lengths are
those of the original data. Sources: nerfstudio's page "Data conventions" and its reader of this format
(nerfstudio_dataparser.py), the Blender scenes of NeRF (Mildenhall et al. 2020).
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Annotated

import numpy as np
from annotated_types import Len

from gsbench.errors import InputError
from gsbench.parsing import Number, Record, Text, read_typed, resolved
from gsbench.scene.images import IMAGE_SUFFIXES, image_size
from gsbench.scene.types import Array, CameraModel
from gsbench.words import some_of

log = logging.getLogger(__name__)
Row = Annotated[list[Number], Len(4, 4)]
Matrix = Annotated[list[Row], Len(3, 4)]  # a fourth row is ignored

ONE_FILE = "transforms.json"
SPLIT_FILES = {"train": "transforms_train.json", "test": "transforms_test.json", "val": "transforms_val.json"}
OPENGL = np.diag([1.0, -1.0, -1.0])  # from OpenCV's camera axes to OpenGL's, and back
PosedCamera = tuple[CameraModel, Array, Array]  # with the world-to-camera rotation [3, 3] and translation [3]
ROTATION_TOLERANCE = 1e-3  # largest error of an entry, for matrices written with few digits
PERSPECTIVE, FISHEYE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"), "OPENCV_FISHEYE"


@dataclass(frozen=True, kw_only=True)
class Intrinsics(Record):
    """Intrinsics, of all cameras of a file or of one frame."""

    camera_model: str | None = None
    is_fisheye: bool | None = None  # instant-ngp's key for OPENCV_FISHEYE
    w: Number | None = None
    h: Number | None = None
    fl_x: Number | None = None
    fl_y: Number | None = None
    cx: Number | None = None
    cy: Number | None = None
    camera_angle_x: Number | None = None  # horizontal field of view, radians
    k1: Number | None = None
    k2: Number | None = None
    k3: Number | None = None
    k4: Number | None = None
    p1: Number | None = None
    p2: Number | None = None


@dataclass(frozen=True, kw_only=True)
class FrameRecord(Intrinsics):
    """A frame of the file: a photograph with its pose."""

    file_path: Text
    transform_matrix: Matrix
    mask_path: Text | None = None


@dataclass(frozen=True, kw_only=True)
class TransformsRecord(Intrinsics):
    """The content of ``transforms.json`` as it is written."""

    frames: list[FrameRecord]
    applied_transform: Matrix | None = None
    applied_scale: Number | None = None
    ply_file_path: Text | None = None


@dataclass(frozen=True)
class Transforms:
    """Converted content of a folder's files: cameras by image name, their split, and their points.

    ``split`` are the names for training and for testing, or None if one file holds all images. ``points`` is a PLY
    file; ``applied.undo`` converts its coordinates to those of the cameras. ``has_mask_paths`` says that at least one
    image names a mask.
    """

    files: tuple[Path, ...]
    images: dict[str, PosedCamera]
    split: tuple[list[str], list[str]] | None
    points: Path | None
    applied: AppliedTransform
    has_mask_paths: bool

    @property
    def sources(self) -> tuple[Path, ...]:
        """The files that cameras and points are read from."""
        return (*self.files, *(() if self.points is None else (self.points,)))


@dataclass(frozen=True, eq=False)
class AppliedTransform:
    """The transform and scale that were applied to the original data before it was saved."""

    rotation: Array = field(default_factory=lambda: np.eye(3))  # [3, 3]
    translation: Array = field(default_factory=lambda: np.zeros(3))  # [3]
    scale: float = 1.0

    def undo(self, saved: Array) -> Array:
        """Convert saved points [P, 3] to the coordinates of the original data."""
        original: Array = (saved / self.scale - self.translation) @ self.rotation
        return original


def find_files(folder: Path) -> dict[str, Path]:
    """The one file of a folder, under the key "", or the files of a Blender scene by their split.

    Raises InputError if the folder has neither.
    """
    if (folder / ONE_FILE).is_file():
        return {"": folder / ONE_FILE}
    files = {split: folder / name for split, name in SPLIT_FILES.items() if (folder / name).is_file()}
    if "train" not in files:
        raise InputError(
            f"{folder}: neither {ONE_FILE} nor {SPLIT_FILES['train']} is here: give the folder that holds it, or take "
            "scene=colmap or scene=photos"
        )
    if "test" in files:
        files.pop("val", None)  # reports on Blender's scenes use the training and test views alone
    return files


def read_transforms(folder: Path) -> Transforms:
    """Read the cameras in ``folder``; raises InputError, one line, for a file that cannot be understood."""
    files = find_files(folder)
    records = {split: read_typed(resolved(path), TransformsRecord) for split, path in files.items()}
    images: dict[str, PosedCamera] = {}
    names: dict[str, list[str]] = {split: [] for split in files}
    points, applied = None, AppliedTransform()
    for split, record in records.items():
        path, missing = files[split], []
        applied = _applied_transform(path, record)
        for frame in record.frames:
            name = _image_name(folder, path, frame.file_path)
            if name is None:
                missing.append(frame.file_path)
                continue
            if name in images:
                raise InputError(f"{path}: {name} is there twice: name each image once")
            images[name] = _camera(folder / name, path, record, frame), *_pose(path, frame, applied)
            names[split].append(name)
        if missing:
            log.warning(
                "%s: %d of %d images have no file: %s", path, len(missing), len(record.frames), some_of(missing)
            )
        if record.ply_file_path is not None:
            points = folder / _relative_path(path, record.ply_file_path)
            if not points.is_file():
                raise InputError(f"{path} names {record.ply_file_path}, which is not there")
    held_out = next((sorted(names[split]) for split in ("test", "val") if split in files), None)
    return Transforms(
        tuple(files.values()),
        dict(sorted(images.items())),
        None if held_out is None else (sorted(names["train"]), held_out),
        points,
        applied,
        any(frame.mask_path for record in records.values() for frame in record.frames),
    )


def _relative_path(path: Path, written: str) -> PurePosixPath:
    """The path ``written`` in the file ``path``; raises InputError if it leads out of the file's folder."""
    relative = PurePosixPath(written.replace("\\", "/"))
    if relative.is_absolute() or ".." in relative.parts or PureWindowsPath(written).drive:
        raise InputError(f"{path}: {written} lies outside the folder of the file: name images relative to it")
    return relative


def _image_name(folder: Path, path: Path, written: str) -> str | None:
    """The image file that ``file_path`` means, or None if there is none. Blender's files leave out the extension."""
    relative = _relative_path(path, written)
    if relative.suffix.lower() in IMAGE_SUFFIXES and (folder / relative).is_file():
        return relative.as_posix()
    candidates = (f"{relative}{suffix}" for suffix in sorted(IMAGE_SUFFIXES))
    existing = [name for name in candidates if (folder / name).is_file()]
    if len(existing) > 1:
        raise InputError(f"{path}: {written} may be {' or '.join(existing)}: add the extension")
    return existing[0] if existing else None


def _applied_transform(path: Path, record: TransformsRecord) -> AppliedTransform:
    scale = 1.0 if record.applied_scale is None else record.applied_scale
    if not scale > 0:
        raise InputError(f"{path}: applied_scale must be positive, got {scale}")
    if record.applied_transform is None:
        return AppliedTransform(scale=scale)
    matrix = np.array(record.applied_transform[:3])  # [3, 4]
    return AppliedTransform(nearest_rotation(matrix[:, :3], f"{path}: applied_transform"), matrix[:, 3], scale)


def nearest_rotation(matrix: Array, what: str) -> Array:
    """The rotation nearest to ``matrix`` [3, 3]; raises InputError if ``matrix`` is far from a rotation."""
    left, _, right = np.linalg.svd(matrix)
    nearest: Array = left @ right
    if np.abs(nearest - matrix).max() > ROTATION_TOLERANCE or np.linalg.det(matrix) < 0.0:
        raise InputError(f"{what} must only rotate and move, but it scales, shears or mirrors")
    return nearest


def _pose(path: Path, frame: FrameRecord, applied: AppliedTransform) -> tuple[Array, Array]:
    matrix = np.array(frame.transform_matrix[:3])  # [3, 4]
    saved = nearest_rotation(matrix[:, :3], f"{path}: transform_matrix of {frame.file_path}")
    world_from_camera = applied.rotation.T @ saved @ OPENGL
    center = applied.undo(matrix[None, :, 3])[0]
    rotation = world_from_camera.T
    return rotation, -rotation @ center


def _camera(image: Path, path: Path, record: TransformsRecord, frame: FrameRecord) -> CameraModel:
    """The camera of a frame, by the frame's own intrinsics, else by those of the file."""

    def value(name: str) -> float | None:
        own = getattr(frame, name)
        intrinsic: float | None = getattr(record, name) if own is None else own
        return intrinsic

    where = f"{path}: {frame.file_path}"
    width, height = value("w"), value("h")
    if width is None or height is None:
        width, height = image_size(image)
    if width != int(width) or height != int(height) or min(width, height) < 1:
        raise InputError(f"{where}: w and h must be whole numbers of px, got {width} and {height}")
    focal_x, angle = value("fl_x"), value("camera_angle_x")
    if focal_x is None and angle is not None and 0 < angle < math.pi:
        focal_x = width / (2 * math.tan(angle / 2))
    focal_y = value("fl_y") or focal_x
    if focal_x is None or focal_y is None or min(focal_x, focal_y) <= 0.0:
        raise InputError(f"{where}: no focal length: fl_x, or camera_angle_x between 0 and pi, must be given")
    cx, cy = value("cx"), value("cy")
    center = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    model, distortion = _distortion(where, record, frame)
    return CameraModel(model, int(width), int(height), (focal_x, focal_y, *center, *distortion))


def _distortion(where: str, record: TransformsRecord, frame: FrameRecord) -> tuple[str, tuple[float, ...]]:
    """COLMAP's name of the camera model, and its parameters after the principal point."""
    names = ("k1", "k2", "k3", "k4", "p1", "p2")
    # A frame with a coefficient of its own uses none of the file's.
    own = any(getattr(frame, name) is not None for name in names)
    k1, k2, k3, k4, p1, p2 = (getattr(frame if own else record, name) or 0.0 for name in names)
    fisheye = record.is_fisheye if frame.is_fisheye is None else frame.is_fisheye
    model = frame.camera_model or record.camera_model or (FISHEYE if fisheye else "OPENCV")
    if model == FISHEYE:
        return model, (k1, k2, k3, k4)
    if model not in PERSPECTIVE:
        raise InputError(f"{where}: camera_model {model} is not known here ({', '.join((*PERSPECTIVE, FISHEYE))})")
    if k3 or k4:
        raise InputError(f"{where}: k3 and k4 are read of {FISHEYE} alone: leave them out, or make a COLMAP model")
    return ("OPENCV", (k1, k2, p1, p2)) if any((k1, k2, p1, p2)) else ("PINHOLE", ())
