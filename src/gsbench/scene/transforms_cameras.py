"""Cameras of ``transforms.json``: the records of its frames, and their poses in COLMAP's form."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Len

from gsbench.errors import InputError
from gsbench.parsing import Number, Record, Text, table_beside
from gsbench.scene.images import image_size
from gsbench.scene.rules import Finding, given
from gsbench.scene.types import ROTATION_TOLERANCE, Array, CameraModel, nearest_rotation

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

    matrix: Array = field(default_factory=lambda: np.eye(3, 4))  # rotation and translation
    scale: float = 1.0

    def equals(self, other: AppliedTransform) -> bool:
        """Return whether both are the same, to the last bit."""
        return self.scale == other.scale and np.array_equal(self.matrix, other.matrix)

    def undo(self, saved: Array) -> Array:
        """Convert saved points [P, 3] to the coordinates of the original data."""
        original: Array = (saved / self.scale - self.matrix[:, 3]) @ self.matrix[:, :3]
        return original


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
        facts = {"cx": cx, "cy": cy, "width": width, "height": height}
        given("principal-point-of-other-size", across, where, **facts)


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
