"""Cameras of ``transforms.json``: the records of its frames, and their poses in COLMAP's form."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Len

from gsbench.errors import InputError
from gsbench.parsing import Number, Record, Text
from gsbench.scene.images import image_size
from gsbench.scene.rules import Finding, given
from gsbench.scene.types import ROTATION_TOLERANCE, Array, CameraModel, nearest_rotation

Row = Annotated[list[Number], Len(4, 4)]
Optional = Number | None
Matrix = Annotated[list[Row], Len(3, 4)]  # a fourth row must be `LAST_ROW`
LAST_ROW = [0.0, 0.0, 0.0, 1.0]
OPENGL = np.diag([1.0, -1.0, -1.0])  # from OpenCV's camera axes to OpenGL's, and back
PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
FISHEYE = "OPENCV_FISHEYE"
FOCAL_KEYS = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov")
# A principal point may be the centre of a copy of another size if it is off by one factor along
# both sides, up to a tenth.
SAME_SCALE = 0.1
RATIONAL = "FULL_OPENCV"  # OpenCV's: a polynomial of k1, k2, k3 divided by one of k4, k5, k6


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


@dataclass(frozen=True, eq=False)
class AppliedTransform:
    """The transform and scale that were applied to the original data before it was saved."""

    rotation: Array = field(default_factory=lambda: np.eye(3))  # [3, 3]
    translation: Array = field(default_factory=lambda: np.zeros(3))  # [3]
    scale: float = 1.0

    def equals(self, other: AppliedTransform) -> bool:
        """Return whether both are the same, to the last bit."""
        return (
            np.array_equal(self.rotation, other.rotation)
            and np.array_equal(self.translation, other.translation)
            and self.scale == other.scale
        )

    def undo(self, saved: Array) -> Array:
        """Convert saved points [P, 3] to the coordinates of the original data."""
        original: Array = (saved / self.scale - self.translation) @ self.rotation
        return original


def applied_transform_of(path: Path, record: TransformsRecord) -> AppliedTransform:
    scale = 1.0 if record.applied_scale is None else record.applied_scale
    if not scale > 0:
        raise InputError(f"{path}: applied_scale must be positive, got {scale}")
    if record.applied_transform is None:
        return AppliedTransform(scale=scale)
    what = f"{path}: applied_transform"
    matrix = _three_rows(record.applied_transform, what)
    return AppliedTransform(nearest_rotation(matrix[:, :3], what), matrix[:, 3], scale)


def _three_rows(matrix: Matrix, what: str) -> Array:
    """The first three rows [3, 4]; raises InputError if a fourth one is not `LAST_ROW`."""
    if matrix[3:] and not np.allclose(matrix[3], LAST_ROW, atol=ROTATION_TOLERANCE):
        raise InputError(f"{what} must end with the row 0, 0, 0, 1: transpose it if it has columns")
    rows: Array = np.array(matrix[:3])
    return rows


def pose_of(path: Path, frame: FrameRecord, applied: AppliedTransform) -> tuple[Array, Array]:
    what = f"{path}: transform_matrix of {frame.file_path}"
    matrix = _three_rows(frame.transform_matrix, what)
    saved = nearest_rotation(matrix[:, :3], what)
    world_from_camera = applied.rotation.T @ saved @ OPENGL
    center = applied.undo(matrix[None, :, 3])[0]
    rotation = world_from_camera.T
    return rotation, -rotation @ center


def camera_of(image: Path, path: Path, record: TransformsRecord, frame: FrameRecord) -> CameraModel:
    """The camera of a frame, by the frame's own intrinsics, else by those of the file."""

    def value(name: str) -> float | None:
        own = getattr(frame, name)
        intrinsic: float | None = getattr(record, name) if own is None else own
        return intrinsic

    where = f"{path}: {frame.file_path}"
    _check_own_size(where, record, frame)
    width, height = value("w"), value("h")
    if width is None or height is None:
        width, height = image_size(image)
        _check_center(where, (width, height), (value("cx"), value("cy")))
    if width != int(width) or height != int(height) or min(width, height) < 1:
        raise InputError(f"{where}: w and h must be whole numbers of px, got {width} and {height}")
    source = _source(record, frame, FOCAL_KEYS)
    focal_x = _focal_length(width, source.fl_x, source.camera_angle_x, source.x_fov)
    focal_y = _focal_length(height, source.fl_y, source.camera_angle_y, source.y_fov)
    # Pixels are square if only one of both is given, as in instant-ngp and nerfstudio.
    focal_x, focal_y = (
        focal_y if focal_x is None else focal_x,
        focal_x if focal_y is None else focal_y,
    )
    if focal_x is None or focal_y is None or min(focal_x, focal_y) <= 0.0:
        raise InputError(
            f"{where}: no focal length: fl_x, camera_angle_x (between 0 and pi) or x_fov (between "
            "0 and 180) must be given, or the same for y"
        )
    cx, cy = value("cx"), value("cy")
    center = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
    model, distortion = _distortion(where, record, frame)
    return CameraModel(model, int(width), int(height), (focal_x, focal_y, *center, *distortion))


def _source(record: TransformsRecord, frame: FrameRecord, keys: Collection[str]) -> Intrinsics:
    """The frame, if it has a value of its own for one of ``keys``, else the file; never a mix."""
    return frame if any(getattr(frame, key) is not None for key in keys) else record


def _check_own_size(where: str, record: TransformsRecord, frame: FrameRecord) -> None:
    """Raise InputError if the file's intrinsics in px belong to another size than the frame's."""
    sizes = [(frame.w, record.w), (frame.h, record.h)]
    if not any(own is not None and shared is not None and own != shared for own, shared in sizes):
        return
    in_pixels = ("fl_x", "fl_y", "cx", "cy")
    if borrowed := [
        key for key in in_pixels if getattr(frame, key) is None and getattr(record, key) is not None
    ]:
        raise InputError(
            f"{where}: it has another size (w, h) than the file, whose {', '.join(borrowed)} are "
            "px of the file's size: give the frame its own"
        )


def _check_center(
    where: str, size: tuple[float, float], center: tuple[float | None, float | None]
) -> None:
    """Raise InputError if the principal point is the centre of a copy of another size."""
    cx, cy = center
    if cx is None or cy is None:
        return
    ratios = [2 * cx / size[0], 2 * cy / size[1]]  # 1 at the centre
    if min(ratios) <= 0 or abs(math.log(ratios[0] / ratios[1])) > math.log(1 + SAME_SCALE):
        return
    facts = {"cx": cx, "cy": cy, "width": size[0], "height": size[1]}
    given("principal-point-of-other-size", ratios[0], where, **facts)


def _distortion(
    where: str, record: TransformsRecord, frame: FrameRecord
) -> tuple[str, tuple[float, ...]]:
    """COLMAP's name of the camera model, and its parameters after the principal point."""
    names = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
    source = _source(record, frame, names)
    k1, k2, k3, k4, k5, k6, p1, p2 = (getattr(source, name) or 0.0 for name in names)
    fisheye = record.is_fisheye if frame.is_fisheye is None else frame.is_fisheye
    model = frame.camera_model or record.camera_model or (FISHEYE if fisheye else "OPENCV")
    if model == FISHEYE:
        if any((k5, k6, p1, p2)):
            raise InputError(
                f"{where}: {FISHEYE} has k1 to k4 alone, but k5, k6, p1 or p2 is not 0"
            )
        return model, (k1, k2, k3, k4)
    if model == RATIONAL:
        return model, (k1, k2, p1, p2, k3, k4, k5, k6)
    if model not in PERSPECTIVE:
        raise InputError(
            f"{where}: camera_model {model} is not known here "
            f"({', '.join((*PERSPECTIVE, RATIONAL, FISHEYE))})"
        )
    # k4 is a coefficient of r^8 in nerfstudio and Metashape, but a divisor in OpenCV; only RATIONAL
    # says which.
    if any((k4, k5, k6)):
        raise InputError(
            f"{where}: k4, k5 and k6 are read of {FISHEYE} and {RATIONAL} alone: make a COLMAP "
            "model"
        )
    if k3:
        return RATIONAL, (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return ("OPENCV", (k1, k2, p1, p2)) if any((k1, k2, p1, p2)) else ("PINHOLE", ())


def _focal_length(
    side: float, given: float | None, angle: float | None, degrees: float | None
) -> float | None:
    """The focal length in px along a side, given or from the field of view (radians or degrees).

    None if nothing is given, and 0 if the field of view is not between 0 and 180 degrees.
    """
    if given is not None:
        return given
    if angle is None and degrees is not None:
        angle = math.radians(degrees)
    if angle is None:
        return None
    return side / (2 * math.tan(angle / 2)) if 0 < angle < math.pi else 0.0


def focal_ratios(record: TransformsRecord, camera: CameraModel) -> list[Finding]:
    """Focal lengths over those that fields of view mean, where a record gives both."""
    found = []
    for source in (record, *record.frames):
        width = camera.width if source.w is None else source.w
        height = camera.height if source.h is None else source.h
        given = (source.fl_x, source.fl_y)
        meant = (
            _focal_length(width, None, source.camera_angle_x, source.x_fov),
            _focal_length(height, None, source.camera_angle_y, source.y_fov),
        )
        for length, other in zip(given, meant, strict=True):
            if length and other:
                name = [source.file_path] if isinstance(source, FrameRecord) else ["the file"]
                found.append(Finding(length / other, name, {"given": length, "meant": other}))
    return found
