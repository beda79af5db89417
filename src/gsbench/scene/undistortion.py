"""Undistorting photographs with COLMAP, and refusing lenses for which that is not possible."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.scene.rules import Finding
from gsbench.scene.types import Camera, CameraModel, to_pinhole
from gsbench.system.isolate import CrashError, run_isolated
from gsbench.words import some_of

if TYPE_CHECKING:
    import pycolmap

Flattened = tuple[float, int, int]


def lens_findings(cameras: Mapping[str, CameraModel]) -> dict[str, list[Finding]]:
    """Findings for the rules of lenses, of the distorted images' cameras."""
    names: dict[CameraModel, list[str]] = {}
    for name, camera in cameras.items():
        names.setdefault(camera, []).append(name)
    if not names:
        return {}
    try:
        flattened: list[Flattened] = run_isolated(flatten, list(names), what="undistortion")
    except CrashError as error:
        raise InputError(f"{error}: check the cameras of {some_of(list(cameras))}") from error
    found: dict[str, list[Finding]] = {"lens-turns-back": [], "little-left": []}
    for (camera, users), (share, width, height) in zip(names.items(), flattened, strict=True):
        facts = {
            "camera": f"{camera.name}: {', '.join(f'{value:g}' for value in camera.params)}",
            "size": f"{width}x{height}",
            "full": f"{camera.width}x{camera.height}",
        }
        found["lens-turns-back"].append(Finding(share, users, facts))
        left = width * height / (camera.width * camera.height)
        found["little-left"].append(Finding(left, users, facts))
    return found


def flatten(cameras: Sequence[CameraModel]) -> list[Flattened]:
    """`folded_share` and the size in px of each camera's undistorted photograph.

    COLMAP's native code can abort, so run it isolated.
    """
    import pycolmap

    from gsbench.scene.distortion import folded_share

    found = []
    for camera in cameras:
        source = _colmap_camera(camera)
        try:
            pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), source)
        except (ValueError, RuntimeError) as error:
            raise InputError(_no_pinhole(camera)) from error
        found.append((folded_share(source, pinhole), pinhole.width, pinhole.height))
    return found


def _colmap_camera(camera: CameraModel) -> pycolmap.Camera:
    """The camera as COLMAP's; raises `InputError` for a full panorama."""
    import pycolmap  # slow to load, and not needed for pinhole images

    size = {"width": camera.width, "height": camera.height}
    source = pycolmap.Camera(model=camera.name, params=list(camera.params), **size)
    if source.is_spherical():
        raise InputError(_no_pinhole(camera))
    return source


def _no_pinhole(camera: CameraModel) -> str:
    return (
        f"images of the camera model {camera.name} with parameters {camera.params} cannot be made "
        "pinhole images: use another camera model"
    )


def flat_camera(camera: CameraModel) -> Camera:
    """The pinhole camera, at the origin, of what `undistort` makes of a photograph."""
    if not camera.distorted:
        return to_pinhole(camera)
    import pycolmap

    from gsbench.scene.colmap import plain_camera

    options = pycolmap.UndistortCameraOptions()
    return to_pinhole(plain_camera(pycolmap.undistort_camera(options, _colmap_camera(camera))))


def undistort(image: NDArray[np.uint8], camera: CameraModel) -> tuple[NDArray[np.uint8], Camera]:
    """Undistort one image [H, W, 3] of any perspective COLMAP camera model; its size changes.

    Raises `InputError` for a camera without a pinhole image (a full panorama) or with impossible
    parameters.
    """
    import pycolmap

    from gsbench.scene.colmap import plain_camera

    source = _colmap_camera(camera)
    bitmap = pycolmap.Bitmap.from_array(np.ascontiguousarray(image))
    try:
        flat, pinhole = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, source)
    except (ValueError, RuntimeError) as error:
        raise InputError(_no_pinhole(camera)) from error
    return np.array(flat.to_array()), to_pinhole(plain_camera(pinhole))
