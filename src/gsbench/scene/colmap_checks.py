"""What the records of a COLMAP model must fulfil, whatever file format they come from."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence

from gsbench.errors import InputError

MAX_SIDE = 1_000_000  # px
MAX_ID = 2**32 - 2  # COLMAP's ids of cameras and images are unsigned, and the last stands for none
TWO_FOCAL_LENGTHS = (
    "PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE",
)  # fmt: skip


class ModelChecks:
    """Sees the records of a model one by one, cameras first; raises `InputError` for the first that is nonsense."""

    def __init__(self) -> None:
        self._cameras: set[int] = set()
        self._points2d: dict[int, int] = {}  # of each image
        self._names: set[str] = set()
        self._points: set[int] = set()

    def camera(self, camera_id: int, model: str, width: int, height: int, params: Sequence[float]) -> None:
        focal_lengths = params[: 2 if model in TWO_FOCAL_LENGTHS else 1]
        is_size = 1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE
        if not is_size or not all(map(math.isfinite, params)) or min(focal_lengths) <= 0:
            raise InputError(
                f"camera {camera_id} is damaged ({width}x{height} px, parameters {', '.join(f'{p:g}' for p in params)})"
            )
        _once(camera_id, self._cameras, "camera", MAX_ID)
        self._cameras.add(camera_id)

    def image(self, image_id: int, pose: Sequence[float], camera_id: int, name: str, num_points: int) -> None:
        self.pose(f"image {image_id} ({name!r})", pose)
        _once(image_id, self._points2d, "image", MAX_ID)
        if camera_id not in self._cameras:
            raise InputError(f"image {image_id} names camera {camera_id}, which the model lacks")
        if not name or name in self._names:
            raise InputError(f"image {image_id} has no name of its own ({name!r})")
        self._points2d[image_id] = num_points
        self._names.add(name)

    def pose(self, owner: str, pose: Sequence[float]) -> None:
        """``pose``: quaternion (w, x, y, z) and translation."""
        if len(pose) != 7 or not all(map(math.isfinite, pose)) or not math.hypot(*pose[:4]) > 0:
            raise InputError(f"{owner} has no pose that can be used ({', '.join(f'{value:g}' for value in pose)})")

    def point(self, point_id: int, position: Sequence[float], track: Iterable[Sequence[int]]) -> None:
        if not all(map(math.isfinite, position)):
            raise InputError(f"point {point_id} lies nowhere ({', '.join(f'{value:g}' for value in position)})")
        _once(point_id, self._points, "point", 2**64 - 2)
        self._points.add(point_id)
        for image_id, index in track:
            if not 0 <= index < self._points2d.get(image_id, 0):
                raise InputError(
                    f"point {point_id} is seen by 2D point {index} of image {image_id}, which is not there"
                )


def _once(number: int, known: Collection[int], what: str, largest: int) -> None:
    if number in known or not 0 <= number <= largest:
        raise InputError(f"{what} {number} is there twice, or has no number")
