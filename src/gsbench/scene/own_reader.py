"""The contract of a user's reader of captures (``scene=reader``), and a check of what it reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Protocol

import numpy as np

from gsbench.errors import InputError
from gsbench.scene.colmap_checks import PARAMETERS
from gsbench.scene.transforms_cameras import PosedCamera, nearest_rotation
from gsbench.scene.types import CameraModel

if TYPE_CHECKING:
    from gsbench.scene.colmap import Cloud


@dataclass(frozen=True)
class PosedImages:
    """Photographs with cameras, in one coordinate system of any origin and scale.

    ``images`` maps a photograph's path below the folder to its camera (COLMAP's model, sizes in px
    and parameters in COLMAP's order; the centre of the first pixel is (0.5, 0.5)), and to the
    rotation [3, 3] and translation [3] from the world to the camera (x right, y down, z forward).
    ``points``, if any, are positions [P, 3] with colours [P, 3] uint8. ``files`` are the other
    files that were read. ``split`` has the names for training and for testing of the capture's own
    split, which ``scene.split=list`` uses.
    """

    images: Mapping[str, PosedCamera]
    points: Cloud | None = None
    files: Sequence[Path] = ()
    split: tuple[list[str], list[str]] | None = None


class SceneReader(Protocol):
    """A reader of captures; its options are the fields of its dataclass.

    It is called whenever a trial begins, and must only read: gsbench chooses, splits, undistorts
    and shrinks the photographs. Results are stored under what it returns, its options and its code.
    """

    def read(self, folder: Path) -> PosedImages:
        """Read the capture in ``folder`` (``scene.path``)."""


def read_posed_images(reader: SceneReader, folder: Path) -> PosedImages:
    """The capture that the user's ``reader`` reads; raises InputError that names its fault."""
    name = f"scene: {type(reader).__module__}.{type(reader).__qualname__}"
    try:
        posed = reader.read(folder)
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # it may raise anything
        raise InputError(
            f"{name} cannot read {folder} ({type(error).__name__}: {error})"
        ) from error
    if not isinstance(posed, PosedImages):
        raise InputError(
            f"{name}: read() must return gsbench.scene.own_reader.PosedImages, got "
            f"{type(posed).__name__}"
        )
    images = {}
    for image, camera in posed.images.items():
        try:
            images[str(image)] = _checked(folder, image, *camera)
        except (AttributeError, TypeError, ValueError, InputError) as error:
            raise InputError(f"{name}: {image}: {error}") from error
    points = None
    if posed.points is not None:
        positions, colors = np.asarray(posed.points[0], float), np.asarray(posed.points[1])
        if positions.shape != (len(positions), 3) or not np.isfinite(positions).all():
            raise InputError(f"{name}: points must be finite numbers [P, 3]")
        if colors.shape != positions.shape or colors.dtype != np.uint8:
            raise InputError(f"{name}: colours of points must be uint8 [P, 3], as the points")
        points = positions, colors
    # in the order of the names, by which test views are chosen
    return replace(posed, images=dict(sorted(images.items())), points=points)


def _checked(
    folder: Path, image: str, camera: CameraModel, rotation: object, translation: object
) -> PosedCamera:
    """A photograph's camera and pose; raises InputError or ValueError for unusable ones."""
    from gsbench.scene.colmap import new_camera  # loads pycolmap

    place = PurePath(image)
    if place.is_absolute() or ".." in place.parts or not (folder / place).is_file():
        raise InputError(f"no such file in {folder}")
    if camera.name not in PARAMETERS:
        raise InputError(f"{camera.name!r} is no camera model of COLMAP, such as PINHOLE")
    params = tuple(map(float, camera.params))
    if not np.isfinite(params).all():
        raise InputError("the camera's parameters must be finite")
    made = new_camera(1, camera.name, camera.width, camera.height, params)
    if not made.verify_params() or min(made.focal_length_x, made.focal_length_y) <= 0:
        raise InputError(f"{camera} is not a camera of COLMAP: it has {made.params_info}")
    moved = np.asarray(translation, float)
    turned = np.asarray(rotation, float)
    if turned.shape != (3, 3) or moved.shape != (3,):
        raise InputError("a pose is a rotation [3, 3] and a translation [3]")
    if not (np.isfinite(turned).all() and np.isfinite(moved).all()):
        raise InputError("the pose must be finite")
    rotation = nearest_rotation(turned, "the rotation")
    return CameraModel(camera.name, int(camera.width), int(camera.height), params), rotation, moved
