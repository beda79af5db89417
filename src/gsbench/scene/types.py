"""Types of a scene: `Camera`, `Capture` before initialisation, and `Scene` of views with cameras.

Also measures of cameras: the scene extent, and the distance of test cameras from the training
cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.normalization import IDENTITY, Normalization
from gsbench.runs.trial_record import Oddity, TwinViews

Array = NDArray[np.float64]
ByteArray = NDArray[np.uint8]
Mask = NDArray[np.bool_]  # [H, W], True where a pixel counts

# 3DGS: cameras_extent = 1.1 x the largest distance of a training camera to their mean
EXTENT_MARGIN = 1.1
PINHOLE_NAMES = ("SIMPLE_PINHOLE", "PINHOLE")


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera in OpenCV axes (x right, y down, z forward).

    ``fx, fy, cx, cy`` are in pixels, in COLMAP's convention: the centre of the first pixel is (0.5,
    0.5), so a centred principal point is ``cx = width / 2``. ``rotation`` [3, 3] and
    ``translation`` [3] map a world point to camera coordinates: ``x_camera = rotation @ x_world +
    translation`` (float64).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(
                f"camera: width and height must be at least 1 px, got {self.width}x{self.height}"
            )
        if not np.isfinite(self.params).all() or min(self.fx, self.fy) <= 0:
            raise ValueError(
                "camera: fx, fy, cx and cy must be finite, and fx and fy positive, got "
                f"{self.params}"
            )
        rotation = np.asarray(self.rotation, dtype=np.float64)
        translation = np.asarray(self.translation, dtype=np.float64)
        # 1e-4: quaternions are written with few digits, and pycolmap accepts any length
        if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
            raise ValueError("camera: rotation must be an orthonormal 3x3 matrix")
        if translation.shape != (3,) or not np.isfinite(translation).all():
            raise ValueError("camera: translation must be three finite numbers")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @property
    def params(self) -> tuple[float, ...]:
        """The intrinsics in px, in the order of COLMAP's PINHOLE."""
        return self.fx, self.fy, self.cx, self.cy

    @property
    def center(self) -> Array:
        """The camera centre in world units, [3]."""
        return -self.rotation.T @ self.translation

    def in_own_coordinates(self, normalization: Normalization) -> Camera:
        """The camera in the coordinates in which the scene was given."""
        if normalization.is_identity:
            return self
        return replace(self, translation=-self.rotation @ normalization.undo(self.center))

    def resized(self, width: int, height: int) -> Camera:
        """The same camera for the same image at another size in pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )


@dataclass(frozen=True)
class CameraModel:
    """A COLMAP camera as plain values: model name, size in px, parameters in COLMAP's order."""

    name: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def distorted(self) -> bool:
        return self.name not in PINHOLE_NAMES


# a camera with its rotation [3, 3] and translation [3] from the world to it
Posed = tuple[CameraModel, Array, Array]


def to_pinhole(camera: CameraModel) -> Camera:
    """Convert an undistorted COLMAP camera to a `Camera` at the origin."""
    fx, fy, cx, cy = (
        camera.params if camera.name == "PINHOLE" else (camera.params[0], *camera.params)
    )
    return Camera(camera.width, camera.height, fx, fy, cx, cy, np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class Capture:
    """Photographs on disk, and the cameras that came with them, if any.

    ``images`` is the folder, ``image_names`` are the selected files in it (relative, sorted), and
    ``test_names`` are the held-out ones. ``held_out`` describes in words how they were chosen.
    ``model`` is a COLMAP sparse folder with reference cameras, or None for bare photographs;
    ``exact_poses`` says that its poses are the truth (a procedural scene), not an estimate.
    ``masks`` are mask files by image name; it is empty if every pixel counts. ``beside`` are other
    files of the photographs by kind (``depth`` and names of folders), by image name.
    ``fingerprint`` is a sha256 over names and contents of the selected images, their masks and the
    model. ``read_from``
    are further files of the user that the cameras were read from. ``advised_normalization`` maps
    the given coordinates to those in which the scene should be trained
    (`gsbench.scene.colmap.normalize_capture`). ``normalization`` is the map that was applied to
    ``model`` already. ``left_out`` maps each photograph that is left out to the one with the same
    name or content. ``oddities`` is what rules found, ``accept`` are the ids of accepted rules
    (`gsbench.scene.rules`).
    """

    name: str
    images: Path
    image_names: tuple[str, ...]
    test_names: tuple[str, ...]
    model: Path | None
    exact_poses: bool
    fingerprint: str
    held_out: str = ""
    masks: Mapping[str, Path] = field(default_factory=dict)
    beside: Mapping[str, Mapping[str, Path]] = field(default_factory=dict)
    read_from: tuple[Path, ...] = ()
    advised_normalization: Normalization = IDENTITY
    normalization: Normalization = IDENTITY
    left_out: Mapping[str, str] = field(default_factory=dict)
    oddities: tuple[Oddity, ...] = ()
    accept: tuple[str, ...] = ()

    @property
    def train_names(self) -> tuple[str, ...]:
        held_out = set(self.test_names)
        return tuple(name for name in self.image_names if name not in held_out)


@dataclass(frozen=True)
class View:
    """One photograph with its camera; ``image`` is [H, W, 3] uint8, sRGB.

    ``mask`` [H, W] is True where a pixel counts, or None if all pixels count. Ignored pixels hold
    the colours made by `gsbench.scene.beside.fill_ignored`. ``beside`` are the pictures that
    ``scene.beside`` names, as `gsbench.scene.beside` reads them.
    """

    name: str
    camera: Camera
    image: ByteArray
    mask: Mask | None = None
    beside: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    @property
    def counted(self) -> float:
        """The share of pixels that count."""
        return 1.0 if self.mask is None else float(self.mask.mean())


@dataclass(frozen=True)
class Scene:
    """The views that a trial trains on and is tested on, undistorted and at their final size."""

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    twins: TwinViews = field(default_factory=TwinViews)
    oddities: tuple[Oddity, ...] = ()

    @cached_property
    def extent(self) -> float:
        """3DGS's ``cameras_extent`` of the training cameras, in world units."""
        return extent_of_centers(np.stack([view.camera.center for view in self.train]))


ROTATION_TOLERANCE = 1e-3  # largest error of an entry, for matrices written with few digits


def nearest_rotation(matrix: Array, what: str) -> Array:
    """The rotation nearest to ``matrix`` [3, 3]; raises InputError if that is far from it."""
    # U V^T of the singular value decomposition is the nearest orthogonal matrix (Schönemann 1966).
    left, _, right = np.linalg.svd(matrix)
    nearest: Array = left @ right
    if np.abs(nearest - matrix).max() > ROTATION_TOLERANCE or np.linalg.det(matrix) < 0.0:
        raise InputError(f"{what} must only rotate and move, but it scales, shears or mirrors")
    return nearest


def extent_of_centers(centers: Array) -> float:
    """1.1 x the largest distance of a centre [V, 3] from their mean, world units (3DGS)."""
    return float(EXTENT_MARGIN * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())


ANGLE, DISTANCE = "angle_to_nearest", "distance_to_nearest"
# the share of a view's pixels that its mask does not ignore; only for views with masks
COUNTED = "counted"


def nearest_training_cameras(
    cameras: Sequence[Camera], training: Sequence[Camera], extent: float
) -> list[dict[str, float]]:
    """Measure how far each camera is from the training cameras nearest in angle and in position.

    ``angle_to_nearest`` is the smallest angle between the viewing directions, in degrees.
    ``distance_to_nearest`` is the smallest distance between the centres, in scene extents; it is
    left out if the extent is 0.
    """
    from scipy.spatial.distance import cdist  # slow to import

    if not cameras or not training:
        return [{} for _ in cameras]

    def from_nearest(place: Callable[[Camera], Array]) -> Array:
        """The distance [V] of each camera's place from the nearest one of training."""
        apart: Array = cdist(*(list(map(place, group)) for group in (cameras, training)))
        return apart.min(axis=1)

    # The chord is accurate near an angle of 0, the arc cosine is not.
    chords = from_nearest(lambda camera: camera.rotation[2])
    angles = 2 * np.degrees(np.arcsin(np.clip(chords / 2, 0.0, 1.0)))
    measured = [{ANGLE: float(angle)} for angle in angles]
    if extent > 0:
        for values, distance in zip(
            measured, from_nearest(lambda camera: camera.center), strict=True
        ):
            values[DISTANCE] = float(distance) / extent
    return measured
