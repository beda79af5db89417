"""Checks of the records of a COLMAP model: what pycolmap would crash on, or misread."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence

from gsbench.errors import InputError


class NamesError(InputError):
    """Raised for a record whose message says what to do."""


# Id of each camera model: its name and number of parameters. Source: COLMAP's
# src/colmap/sensor/models.h.
MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
PARAMETERS = dict(MODELS.values())  # the number of them, by the name of the model
NEARLY = 0.01  # the length of a quaternion in a text differs from 1 by less
# Largest length of a quaternion; the smallest is 1 / MAX_LENGTH. COLMAP normalises quaternions of
# any length.
MAX_LENGTH = 1e6
MAX_SIDE = 1_000_000  # px
# ids of cameras and images are 32-bit; the largest number means "no id" in COLMAP
MAX_ID = 2**32 - 2
MAX_POINT_ID = 2**64 - 2  # ids of 3D points are 64-bit


class ModelChecks:
    """Checks records one by one, cameras first; raises `InputError` for the first bad one."""

    def __init__(self) -> None:
        self._cameras: set[int] = set()
        self._points2d: dict[int, int] = {}  # number of 2D points by image id
        self._names: set[str] = set()
        self._points: set[int] = set()

    def camera(
        self, camera_id: int, model: str, width: int, height: int, params: Sequence[float]
    ) -> None:
        focal_lengths = params[: 1 if model.startswith(("SIMPLE_", "RADIAL")) else 2]
        is_size = 1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE
        if not is_size or not all(map(math.isfinite, params)) or min(focal_lengths) <= 0:
            raise InputError(
                f"camera {camera_id} is damaged ({width}x{height} px, parameters {_listed(params)})"
            )
        _check_id(camera_id, self._cameras, "camera", MAX_ID)
        self._cameras.add(camera_id)

    def image(
        self, image_id: int, pose: Sequence[float], camera_id: int, name: str, num_points: int
    ) -> None:
        self.pose(f"image {image_id} ({name!r})", pose)
        _check_id(image_id, self._points2d, "image", MAX_ID)
        if camera_id not in self._cameras:
            raise InputError(f"image {image_id} names camera {camera_id}, which the model lacks")
        if not name or name in self._names:
            raise InputError(f"image {image_id} has no name of its own ({name!r})")
        self._points2d[image_id] = num_points
        self._names.add(name)

    def pose(self, owner: str, pose: Sequence[float]) -> None:
        """Check a pose: quaternion (w, x, y, z) and translation."""
        sound = len(pose) == 7 and all(map(math.isfinite, pose))
        if not sound or not 1 / MAX_LENGTH < math.hypot(*pose[:4]) < MAX_LENGTH:
            raise InputError(f"{owner} has no pose that can be used ({_listed(pose)})")

    def point(
        self, point_id: int, position: Sequence[float], track: Iterable[Sequence[int]]
    ) -> None:
        if not all(map(math.isfinite, position)):
            raise InputError(f"point {point_id} has no finite position ({_listed(position)})")
        _check_id(point_id, self._points, "point", MAX_POINT_ID)
        self._points.add(point_id)
        for image_id, index in track:
            if not 0 <= index < self._points2d.get(image_id, 0):
                raise InputError(
                    f"point {point_id} is seen by 2D point {index} of image {image_id}, which is "
                    "not there"
                )


class NamesOnly(ModelChecks):
    """Collects the names of images, and checks nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.names: dict[int, str] = {}

    def image(
        self, image_id: int, pose: Sequence[float], camera_id: int, name: str, num_points: int
    ) -> None:
        self.names[image_id] = name


def _listed(numbers: Sequence[float]) -> str:
    return ", ".join(f"{number:g}" for number in numbers)


def _check_id(number: int, earlier: Collection[int], what: str, largest: int) -> None:
    if number in earlier:
        raise InputError(f"{what} {number} appears twice")
    if not 0 <= number <= largest:
        raise InputError(f"{what} {number}: the number must be from 0 to {largest}")
