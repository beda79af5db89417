"""The record of a photograph, which every reader returns, and the contract of a user's reader."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from gsbench.errors import InputError
from gsbench.scene.images import open_image
from gsbench.scene.rules import Finding
from gsbench.scene.types import Array, CameraModel, Posed, nearest_rotation
from gsbench.scene.undistortion import as_colmap

if TYPE_CHECKING:
    from gsbench.scene.colmap import Cloud

Role = Literal["", "train", "test", "unused"]
EQUIRECTANGULAR = b"equirectangular"  # GPano:ProjectionType in the XMP of a panorama


@dataclass(frozen=True, eq=False)
class Photograph:
    """One photograph: its file, camera and pose, and the files that belong to it.

    ``name`` is the path below the capture's folder. ``camera`` is COLMAP's (size in px, parameters
    in COLMAP's order; the centre of the first pixel is (0.5, 0.5)), for an image of this shape and
    any size. ``rotation`` [3, 3] and ``translation`` [3] go from the world to the camera (x right,
    y down, z forward). ``mask`` and ``depth`` are files, ``more`` has others by name. ``role`` is
    what the capture itself says of it.
    """

    name: str
    file: Path
    camera: CameraModel | None = None
    rotation: Array | None = None
    translation: Array | None = None
    mask: Path | None = None
    depth: Path | None = None
    role: Role = ""
    more: Mapping[str, Path] = field(default_factory=dict)

    @cached_property
    def _header(self) -> tuple[tuple[int, int], bool]:
        with open_image(self.file) as image:
            xmp = image.info.get("xmp", b"")
            return image.size, isinstance(xmp, bytes) and EQUIRECTANGULAR in xmp

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the file in px; raises InputError if it is no image."""
        return self._header[0]

    @property
    def is_panorama(self) -> bool:
        """Return whether the file says that it is a full panorama, and has its shape."""
        return self._header[1] and self.size[0] == 2 * self.size[1]

    @property
    def posed(self) -> Posed:
        """The camera and the pose, of a photograph that has them."""
        assert self.camera is not None
        assert self.rotation is not None
        assert self.translation is not None
        return self.camera, self.rotation, self.translation

    @property
    def center(self) -> Array:
        """The camera's centre [3] in world units."""
        _, rotation, translation = self.posed
        return -rotation.T @ translation


@dataclass(frozen=True, eq=False)
class AppliedTransform:
    """The transform and scale that were applied to the original data before it was saved."""

    matrix: Array = field(default_factory=lambda: np.eye(3, 4))  # rotation and translation
    scale: float = 1.0

    def undo(self, saved: Array) -> Array:
        """Convert saved points [P, 3] to the coordinates of the original data."""
        return (saved / self.scale - self.matrix[:, 3]) @ self.matrix[:, :3]

    def equals(self, other: AppliedTransform) -> bool:
        """Return whether both are the same, to the last bit."""
        return self.scale == other.scale and np.array_equal(self.matrix, other.matrix)


@dataclass(frozen=True)
class PointsFile:
    """A file of points, and the transform that was applied to them before they were saved."""

    path: Path
    applied: AppliedTransform


@dataclass(frozen=True)
class RawCapture:
    """A reader's findings in a folder: photographs, and points if there are any.

    ``photographs`` are in the order of their names, by which test views are chosen. ``points`` are
    positions [P, 3] with colours [P, 3] uint8, or their file. ``files`` are the other files that
    were read. ``model`` is a COLMAP model that has the cameras already, and ``centers`` [V, 3] are
    those of all its cameras. `gsbench.scene.pipe` fills ``left_out`` and ``held_out``, as
    `gsbench.scene.types.Capture` has them.
    """

    folder: Path
    photographs: tuple[Photograph, ...]
    points: Cloud | PointsFile | None = None
    files: tuple[Path, ...] = ()
    model: Path | None = None
    centers: Array | None = None
    noted: Mapping[str, Sequence[Finding]] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    held_out: str = ""

    @property
    def names(self) -> list[str]:
        return [photograph.name for photograph in self.photographs]

    @property
    def has_cameras(self) -> bool:
        return any(photograph.camera is not None for photograph in self.photographs)

    @property
    def panoramas(self) -> list[str]:
        """The names of the photographs without a camera that say that they are panoramas."""
        return [row.name for row in self.photographs if row.camera is None and row.is_panorama]

    def named(self, role: Role) -> list[str]:
        """The names of the photographs of one role."""
        return [photograph.name for photograph in self.photographs if photograph.role == role]


class SceneReader(Protocol):
    """A reader of captures; its options are the fields of its dataclass.

    It is called whenever a trial begins, and must only read: gsbench chooses, splits, undistorts
    and shrinks the photographs. Results are stored under what it returns, its options and its code.
    """

    def read(self, folder: Path) -> RawCapture:
        """Read the capture in ``folder`` (``scene.path``)."""


def read_own(reader: SceneReader, folder: Path) -> RawCapture:
    """The capture that the user's ``reader`` reads; raises InputError that names its fault."""
    name = f"scene: {type(reader).__module__}.{type(reader).__qualname__}"
    try:
        raw = reader.read(folder)
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # it may raise anything
        raise InputError(
            f"{name} cannot read {folder} ({type(error).__name__}: {error})"
        ) from error
    if not isinstance(raw, RawCapture):
        raise InputError(
            f"{name}: read() must return gsbench.scene.record.RawCapture, got {type(raw).__name__}"
        )
    photographs = []
    for photograph in raw.photographs:
        try:
            photographs.append(_checked(folder, photograph))
        except (AttributeError, TypeError, ValueError, InputError) as error:
            raise InputError(f"{name}: {getattr(photograph, 'name', '?')}: {error}") from error
    points = None
    if raw.points is not None:
        if not isinstance(raw.points, tuple):
            raise InputError(f"{name}: points must be positions and colours")
        positions, colors = np.asarray(raw.points[0], float), np.asarray(raw.points[1])
        if positions.shape != (len(positions), 3) or not np.isfinite(positions).all():
            raise InputError(f"{name}: points must be finite numbers [P, 3]")
        if colors.shape != positions.shape or colors.dtype != np.uint8:
            raise InputError(f"{name}: colours of points must be uint8 [P, 3], as the points")
        points = positions, colors
    ordered = tuple(sorted(photographs, key=lambda photograph: photograph.name))
    return RawCapture(folder, ordered, points, tuple(raw.files))


def _checked(folder: Path, photograph: Photograph) -> Photograph:
    """The photograph with plain values; raises InputError or ValueError for unusable ones."""
    import pycolmap

    name = str(photograph.name)
    place = PurePath(name)
    if place.is_absolute() or ".." in place.parts or not (folder / place).is_file():
        raise InputError(f"no such file in {folder}")
    camera = photograph.camera
    if camera is None or photograph.rotation is None or photograph.translation is None:
        raise InputError("it has no camera and pose")
    if camera.name not in pycolmap.CameraModelId.__members__:
        raise InputError(f"{camera.name!r} is no camera model of COLMAP, such as PINHOLE")
    params = tuple(map(float, camera.params))
    if not np.isfinite(params).all():
        raise InputError("the camera's parameters must be finite")
    camera = CameraModel(camera.name, int(camera.width), int(camera.height), params)
    made = as_colmap(camera)
    if not made.verify_params() or min(made.focal_length_x, made.focal_length_y) <= 0:
        raise InputError(f"{camera} is not a camera of COLMAP: it has {made.params_info}")
    turned = np.asarray(photograph.rotation, float)
    moved = np.asarray(photograph.translation, float)
    if turned.shape != (3, 3) or moved.shape != (3,):
        raise InputError("a pose is a rotation [3, 3] and a translation [3]")
    if not (np.isfinite(turned).all() and np.isfinite(moved).all()):
        raise InputError("the pose must be finite")
    return replace(
        photograph,
        name=name,
        file=folder / place,
        camera=camera,
        rotation=nearest_rotation(turned, "the rotation"),
        translation=moved,
    )
