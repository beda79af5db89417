"""Cameras in nerfstudio's, instant-ngp's and Blender's ``transforms.json``, as COLMAP's.

A ``transform_matrix`` takes camera coordinates to the world's, in OpenGL's axes (x right, y up, looking along -z);
intrinsics have COLMAP's meaning. ``applied_transform`` and ``applied_scale`` say what was done to the coordinates of
the original data, ``saved = applied_scale * applied_transform(original)``; both are undone, for cameras and points, so
that a length means what it meant there. Sources: nerfstudio's page "Data conventions" and its reader of this format
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
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.parsing import resolved
from gsbench.records import Number, Record, Text, read_typed
from gsbench.scene.camera import CameraModel
from gsbench.scene.images import IMAGE_SUFFIXES, image_size
from gsbench.words import some_of

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Row = Annotated[list[Number], Len(4, 4)]
Matrix = Annotated[list[Row], Len(3, 4)]  # the last row of four says nothing

ONE_FILE = "transforms.json"
SPLIT_FILES = {"train": "transforms_train.json", "test": "transforms_test.json", "val": "transforms_val.json"}
OPENGL = np.diag([1.0, -1.0, -1.0])  # OpenCV's camera axes in OpenGL's, and back
ROTATION_TOLERANCE = 1e-3  # of a matrix that was written with few digits
PERSPECTIVE, FISHEYE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"), "OPENCV_FISHEYE"


@dataclass(frozen=True, kw_only=True)
class Intrinsics(Record):
    """Intrinsics that a file gives all its cameras, or a frame its own."""

    camera_model: str | None = None
    is_fisheye: bool | None = None  # instant-ngp's word for OPENCV_FISHEYE
    w: Number | None = None
    h: Number | None = None
    fl_x: Number | None = None
    fl_y: Number | None = None
    cx: Number | None = None
    cy: Number | None = None
    camera_angle_x: Number | None = None  # of the whole picture, radians
    k1: Number | None = None
    k2: Number | None = None
    k3: Number | None = None
    k4: Number | None = None
    p1: Number | None = None
    p2: Number | None = None


@dataclass(frozen=True, kw_only=True)
class FrameRecord(Intrinsics):
    """A photograph with its pose."""

    file_path: Text
    transform_matrix: Matrix
    mask_path: Text | None = None


@dataclass(frozen=True, kw_only=True)
class TransformsRecord(Intrinsics):
    """``transforms.json``."""

    frames: list[FrameRecord]
    applied_transform: Matrix | None = None
    applied_scale: Number | None = None
    ply_file_path: Text | None = None


@dataclass(frozen=True, eq=False)
class Frame:
    """A photograph: its name below the folder, its camera, the rotation [3, 3] and translation [3] from world to it."""

    name: str
    camera: CameraModel
    rotation: Array
    translation: Array


@dataclass(frozen=True)
class Transforms:
    """Content of a folder's files: ``frames`` by name, the views that they hold out, and their points.

    ``split`` are the names for training and for testing, None where one file has all. ``points`` is a PLY file, whose
    coordinates ``undo`` takes to those of the cameras. ``names_masks``: some image has a mask of its own there.
    """

    files: tuple[Path, ...]
    frames: dict[str, Frame]
    split: tuple[list[str], list[str]] | None
    points: Path | None
    undo: Undo
    names_masks: bool

    @property
    def sources(self) -> tuple[Path, ...]:
        """The files that cameras and points are made from."""
        return (*self.files, *(() if self.points is None else (self.points,)))


@dataclass(frozen=True, eq=False)
class Undo:
    """The way back from a file's coordinates to those of the original data."""

    rotation: Array = field(default_factory=lambda: np.eye(3))  # [3, 3] of the applied transform
    translation: Array = field(default_factory=lambda: np.zeros(3))  # [3]
    scale: float = 1.0

    def points(self, saved: Array) -> Array:
        """The points [P, 3] in the coordinates of the original data."""
        original: Array = (saved / self.scale - self.translation) @ self.rotation
        return original


def find_files(folder: Path) -> dict[str, Path]:
    """The file of a folder, under "", or those of a Blender scene by their part; raises InputError where is none."""
    if (folder / ONE_FILE).is_file():
        return {"": folder / ONE_FILE}
    parts = {part: folder / name for part, name in SPLIT_FILES.items() if (folder / name).is_file()}
    if "train" not in parts:
        raise InputError(
            f"{folder}: neither {ONE_FILE} nor {SPLIT_FILES['train']} is here: give the folder that holds it, or take "
            "scene=colmap or scene=photos"
        )
    if "test" in parts:
        parts.pop("val", None)  # as those who report on these scenes leave it out
    return parts


def read_transforms(folder: Path) -> Transforms:
    """Read the cameras in ``folder``; raises InputError, one line, for what cannot be understood."""
    files = find_files(folder)
    records = {part: read_typed(resolved(path), TransformsRecord) for part, path in files.items()}
    frames: dict[str, Frame] = {}
    by_part: dict[str, list[str]] = {part: [] for part in files}
    points, undo = None, Undo()
    for part, record in records.items():
        path, missing = files[part], []
        undo = _undo(path, record)
        for entry in record.frames:
            name = _image_name(folder, path, entry.file_path)
            if name is None:
                missing.append(entry.file_path)
                continue
            if name in frames:
                raise InputError(f"{path}: {name} is there twice: name each image once")
            frames[name] = Frame(name, _camera(folder / name, path, record, entry), *_pose(path, entry, undo))
            by_part[part].append(name)
        if missing:
            log.warning(
                "%s: %d of %d images have no file: %s", path, len(missing), len(record.frames), some_of(missing)
            )
        if record.ply_file_path is not None:
            points = folder / _inside(path, record.ply_file_path)
            if not points.is_file():
                raise InputError(f"{path} names {record.ply_file_path}, which is not there")
    held_out = next((sorted(by_part[part]) for part in ("test", "val") if part in files), None)
    return Transforms(
        tuple(files.values()),
        dict(sorted(frames.items())),
        None if held_out is None else (sorted(by_part["train"]), held_out),
        points,
        undo,
        any(entry.mask_path for record in records.values() for entry in record.frames),
    )


def _inside(path: Path, named: str) -> PurePosixPath:
    """The place that the file ``path`` names, below its folder."""
    place = PurePosixPath(named.replace("\\", "/"))
    if place.is_absolute() or ".." in place.parts or PureWindowsPath(named).drive:
        raise InputError(f"{path}: {named} lies outside the folder of the file: name images relative to it")
    return place


def _image_name(folder: Path, path: Path, named: str) -> str | None:
    """The image that ``file_path`` means, whose extension Blender's files leave out; None where it is not there."""
    place = _inside(path, named)
    if place.suffix.lower() in IMAGE_SUFFIXES and (folder / place).is_file():
        return place.as_posix()
    there = [f"{place}{suffix}" for suffix in sorted(IMAGE_SUFFIXES) if (folder / f"{place}{suffix}").is_file()]
    if len(there) > 1:
        raise InputError(f"{path}: {named} may be {' or '.join(there)}: add the extension")
    return there[0] if there else None


def _undo(path: Path, record: TransformsRecord) -> Undo:
    scale = 1.0 if record.applied_scale is None else record.applied_scale
    if not scale > 0:
        raise InputError(f"{path}: applied_scale must be positive, got {scale}")
    if record.applied_transform is None:
        return Undo(scale=scale)
    matrix = np.array(record.applied_transform[:3])  # [3, 4]
    return Undo(rotation_of(matrix[:, :3], f"{path}: applied_transform"), matrix[:, 3], scale)


def rotation_of(matrix: Array, what: str) -> Array:
    """The rotation nearest to ``matrix`` [3, 3]; raises InputError where it is far from one."""
    left, _, right = np.linalg.svd(matrix)
    nearest: Array = left @ right
    if np.abs(nearest - matrix).max() > ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
        raise InputError(f"{what} must only rotate and move, but it scales, shears or mirrors")
    return nearest


def _pose(path: Path, frame: FrameRecord, undo: Undo) -> tuple[Array, Array]:
    matrix = np.array(frame.transform_matrix[:3])  # [3, 4]
    saved = rotation_of(matrix[:, :3], f"{path}: transform_matrix of {frame.file_path}")
    world_from_camera = undo.rotation.T @ saved @ OPENGL
    center = undo.points(matrix[None, :, 3])[0]
    rotation = world_from_camera.T
    return rotation, -rotation @ center


def _camera(image: Path, path: Path, record: TransformsRecord, frame: FrameRecord) -> CameraModel:
    """The camera of a frame: what it says itself, else what its file says of all."""

    def value(name: str) -> float | None:
        own = getattr(frame, name)
        said: float | None = getattr(record, name) if own is None else own
        return said

    whose = f"{path}: {frame.file_path}"
    width, height = value("w"), value("h")
    if width is None or height is None:
        width, height = image_size(image)
    if width != int(width) or height != int(height) or min(width, height) < 1:
        raise InputError(f"{whose}: w and h must be whole numbers of px, got {width} and {height}")
    focal_x, angle = value("fl_x"), value("camera_angle_x")
    if focal_x is None and angle is not None and 0 < angle < math.pi:
        focal_x = width / (2 * math.tan(angle / 2))
    focal_y = value("fl_y") or focal_x
    if focal_x is None or focal_y is None or min(focal_x, focal_y) <= 0:
        raise InputError(f"{whose}: no focal length: fl_x, or camera_angle_x between 0 and pi, must be given")
    center = [half if said is None else said for said, half in ((value("cx"), width / 2), (value("cy"), height / 2))]
    model, distortion = _distortion(whose, record, frame)
    return CameraModel(model, int(width), int(height), (focal_x, focal_y, *center, *distortion))


def _distortion(whose: str, record: TransformsRecord, frame: FrameRecord) -> tuple[str, tuple[float, ...]]:
    """COLMAP's name of the model and what follows the principal point among its parameters."""
    names = ("k1", "k2", "k3", "k4", "p1", "p2")
    own = any(getattr(frame, name) is not None for name in names)
    k1, k2, k3, k4, p1, p2 = (getattr(frame if own else record, name) or 0.0 for name in names)
    fisheye = record.is_fisheye if frame.is_fisheye is None else frame.is_fisheye
    model = frame.camera_model or record.camera_model or (FISHEYE if fisheye else "OPENCV")
    if model == FISHEYE:
        return model, (k1, k2, k3, k4)
    if model not in PERSPECTIVE:
        raise InputError(f"{whose}: camera_model {model} is not known here ({', '.join((*PERSPECTIVE, FISHEYE))})")
    if k3 or k4:
        raise InputError(f"{whose}: k3 and k4 are read of {FISHEYE} alone: leave them out, or make a COLMAP model")
    return ("OPENCV", (k1, k2, p1, p2)) if any((k1, k2, p1, p2)) else ("PINHOLE", ())
