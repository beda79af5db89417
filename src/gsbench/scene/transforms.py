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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Annotated

import numpy as np
from annotated_types import Len
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.parsing import resolved
from gsbench.records import Number, Part, Text, read_typed
from gsbench.scene.images import IMAGE_SUFFIXES, image_size
from gsbench.scene.prepare import CameraModel
from gsbench.words import some_of

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Row = Annotated[list[Number], Len(4, 4)]
Matrix = Annotated[list[Row], Len(3, 4)]  # the last row of four says nothing

ONE_FILE = "transforms.json"
SPLIT_FILES = {"train": "transforms_train.json", "test": "transforms_test.json", "val": "transforms_val.json"}
OPENGL = np.diag([1.0, -1.0, -1.0])  # OpenCV's camera axes in OpenGL's, and back
ROTATION_TOLERANCE = 1e-3  # of a matrix that was written with few digits
PERSPECTIVE, FISHEYE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"), ("OPENCV_FISHEYE",)


@dataclass(frozen=True, kw_only=True)
class Intrinsics(Part):
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
    camera_angle_y: Number | None = None
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
    train_filenames: list[Text] | None = None
    val_filenames: list[Text] | None = None
    test_filenames: list[Text] | None = None


@dataclass(frozen=True, eq=False)
class Frame:
    """A photograph: its name below the folder, its camera, the rotation [3, 3] and translation [3] from world to it."""

    name: str
    camera: CameraModel
    rotation: Array
    translation: Array
    mask: Path | None


@dataclass(frozen=True)
class Transforms:
    """Content of a folder's files: ``frames`` by name, the views that they hold out, and their points.

    ``split`` are the names for training and for testing, None where the files do not say. ``points`` is a PLY file,
    whose coordinates ``undo`` takes to those of the cameras.
    """

    files: tuple[Path, ...]
    frames: dict[str, Frame]
    split: tuple[list[str], list[str]] | None
    points: Path | None
    undo: Undo

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
    frames: dict[str, Frame] = {}
    by_part: dict[str, list[str]] = {}
    split, points, undo = None, None, Undo()
    for part, path in files.items():
        record = read_typed(resolved(path), TransformsRecord)
        undo = _undo(path, record)
        found = {frame.name: frame for frame in _frames(folder, path, record, undo)}
        if twice := sorted(found.keys() & frames.keys()):
            raise InputError(f"{path}: {twice[0]} is in {_other(files, part)} as well: name each image once")
        frames |= found
        by_part[part] = sorted(found)
        split = split or _own_split(folder, path, record)
        if record.ply_file_path is not None:
            points = _existing(folder, path, record.ply_file_path)
    if "train" in by_part and len(by_part) > 1:
        split = by_part["train"], by_part["test" if "test" in by_part else "val"]
    masked = [name for name, frame in frames.items() if frame.mask is not None]
    if masked and len(masked) < len(frames):
        missing = sorted(frames.keys() - set(masked))
        raise InputError(
            f"{next(iter(files.values()))}: no mask_path for {some_of(missing)}: give all images one, or none"
        )
    return Transforms(tuple(files.values()), dict(sorted(frames.items())), split, points, undo)


def _other(files: Mapping[str, Path], part: str) -> str:
    return next((path.name for name, path in files.items() if name != part), ONE_FILE)


def _frames(folder: Path, path: Path, record: TransformsRecord, undo: Undo) -> Iterator[Frame]:
    seen: set[str] = set()
    missing = []
    for frame in record.frames:
        name = _image_name(folder, path, frame.file_path)
        if name is None:
            missing.append(frame.file_path)
            continue
        if name in seen:
            raise InputError(f"{path}: {name} stands there twice: name each image once")
        seen.add(name)
        rotation, translation = _pose(path, frame, undo)
        mask = None if frame.mask_path is None else _existing(folder, path, frame.mask_path)
        yield Frame(name, _camera(folder / name, path, record, frame), rotation, translation, mask)
    if missing:
        log.warning("%s: %d of %d images have no file: %s", path, len(missing), len(record.frames), some_of(missing))


def _inside(folder: Path, path: Path, named: str) -> PurePosixPath:
    """The path that a file names, below its folder."""
    place = Path(named.replace("\\", "/"))
    if place.is_absolute():
        if not place.is_relative_to(folder):
            raise InputError(f"{path}: {named} lies outside the folder of the file: name images relative to it")
        place = place.relative_to(folder)
    if ".." in place.parts:
        raise InputError(f"{path}: {named} lies outside the folder of the file: name images relative to it")
    return PurePosixPath(*place.parts)


def _image_name(folder: Path, path: Path, named: str) -> str | None:
    """The image that ``file_path`` means, whose extension Blender's files leave out; None where it is not there."""
    place = _inside(folder, path, named)
    if place.suffix.lower() in IMAGE_SUFFIXES and (folder / place).is_file():
        return place.as_posix()
    there = [f"{place}{suffix}" for suffix in sorted(IMAGE_SUFFIXES) if (folder / f"{place}{suffix}").is_file()]
    if len(there) > 1:
        raise InputError(f"{path}: {named} may be {' or '.join(there)}: add the extension")
    return there[0] if there else None


def _existing(folder: Path, path: Path, named: str) -> Path:
    place = folder / _inside(folder, path, named)
    if not place.is_file():
        raise InputError(f"{path} names {named}, which is not there")
    return place


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
        raise InputError(f"{what} does not turn and move alone: it scales, shears or mirrors")
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
    focal_x = _focal(value("fl_x"), width, value("camera_angle_x"))
    focal_y = _focal(value("fl_y"), height, value("camera_angle_y")) or focal_x
    if focal_x is None or focal_y is None or min(focal_x, focal_y) <= 0:
        raise InputError(f"{whose}: no focal length: fl_x, or camera_angle_x between 0 and pi, must be given")
    center = [half if said is None else said for said, half in ((value("cx"), width / 2), (value("cy"), height / 2))]
    model, distortion = _distortion(whose, record, frame)
    return CameraModel(model, int(width), int(height), (focal_x, focal_y, *center, *distortion))


def _focal(said: float | None, side: float, angle: float | None) -> float | None:
    if said is not None:
        return said
    return side / (2 * math.tan(angle / 2)) if angle is not None and 0 < angle < math.pi else None


def _distortion(whose: str, record: TransformsRecord, frame: FrameRecord) -> tuple[str, tuple[float, ...]]:
    """COLMAP's name of the model and what follows the principal point among its parameters."""
    names = ("k1", "k2", "k3", "k4", "p1", "p2")
    own = any(getattr(frame, name) is not None for name in names)
    k1, k2, k3, k4, p1, p2 = (getattr(frame if own else record, name) or 0.0 for name in names)
    fisheye = record.is_fisheye if frame.is_fisheye is None else frame.is_fisheye
    model = frame.camera_model or record.camera_model or ("OPENCV_FISHEYE" if fisheye else "OPENCV")
    if model in FISHEYE:
        return "OPENCV_FISHEYE", (k1, k2, k3, k4)
    if model not in PERSPECTIVE:
        raise InputError(f"{whose}: camera_model {model} is not known here ({', '.join((*PERSPECTIVE, *FISHEYE))})")
    if k4:
        raise InputError(f"{whose}: k4 of a camera that is no fisheye has no counterpart in COLMAP: leave it out")
    if k3:
        return "FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return ("OPENCV", (k1, k2, p1, p2)) if any((k1, k2, p1, p2)) else ("PINHOLE", ())


def _own_split(folder: Path, path: Path, record: TransformsRecord) -> tuple[list[str], list[str]] | None:
    """Names for training and for testing by nerfstudio's lists of a file, None where it has none."""
    held_out = record.test_filenames or record.val_filenames
    if not record.train_filenames or not held_out:
        return None
    lists = []
    for names in (record.train_filenames, held_out):
        found = {named: _image_name(folder, path, named) for named in names}
        if absent := [named for named, name in found.items() if name is None]:
            raise InputError(f"{path}: {some_of(absent)} of its split is not there")
        lists.append(sorted(name for name in found.values() if name is not None))
    return lists[0], lists[1]
