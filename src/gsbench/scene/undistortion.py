"""Undistorting photographs with COLMAP, and deciding which lenses need it or cannot be undistorted.

Many exporters write photographs that are undistorted already under a model with distortion whose
coefficients are zero. Undistorting these again would resample every pixel for nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from gsbench.errors import InputError
from gsbench.scene.names import grouped
from gsbench.scene.rules import Finding
from gsbench.scene.types import Array, ByteArray, Camera, CameraModel, to_pinhole
from gsbench.system.isolate import CrashError, run_isolated
from gsbench.words import some_of

if TYPE_CHECKING:
    import pycolmap

# A camera whose projection differs nowhere in the image by more than this (px) from a pinhole's
# counts as a pinhole. The limit is a tenth of the reprojection error of a good COLMAP model (.3 to
# .5 px), so poses are less precise than that. Resampling costs more: it shifts the grid by up to
# half a pixel and averages neighbours.
MAX_IGNORED_DISTORTION = 0.05
GRID = 33  # points per side at which the distance is measured, borders included
FOLD_GRID = 40  # pixels per side for `folded_share`


def lens_findings(cameras: Mapping[str, CameraModel]) -> dict[str, list[Finding]]:
    """Findings for the rules of lenses, of the distorted images' cameras."""
    names = grouped(cameras, cameras.__getitem__)
    if not names:
        return {}
    try:
        flattened = run_isolated(flatten, list(names), what="undistortion")
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


def flatten(cameras: Sequence[CameraModel]) -> list[tuple[float, int, int]]:
    """`folded_share` and the size in px of each camera's undistorted photograph.

    COLMAP's native code can abort, so run it isolated.
    """
    pinholes = map(_pinhole_of, cameras)
    return [
        (folded_share(as_colmap(camera), pinhole), pinhole.width, pinhole.height)
        for camera, pinhole in zip(cameras, pinholes, strict=True)
    ]


def _pinhole_of(camera: CameraModel) -> pycolmap.Camera:
    """COLMAP's camera of the undistorted photograph; raises InputError if there is none."""
    import pycolmap

    return _undistorted(camera, pycolmap.undistort_camera)


def _undistorted(camera: CameraModel, undistort: Callable[..., Any], *picture: Any) -> Any:
    """The result of a function of COLMAP's; raises InputError for what it cannot undistort."""
    import pycolmap

    source = as_colmap(camera)
    try:
        if source.is_spherical():
            raise ValueError("a full panorama")
        return undistort(pycolmap.UndistortCameraOptions(), *picture, source)
    except (ValueError, RuntimeError) as error:
        raise InputError(
            f"images of the camera model {camera.name} with parameters {camera.params} cannot be "
            "made pinhole images: use another camera model"
        ) from error


def as_colmap(camera: CameraModel, camera_id: int = 1) -> pycolmap.Camera:
    """The camera as an object of COLMAP's."""
    import pycolmap  # slow to load, and not needed for pinhole images

    return pycolmap.Camera(
        camera_id=camera_id,
        model=camera.name,
        width=camera.width,
        height=camera.height,
        params=list(camera.params),
    )


def as_values(camera: pycolmap.Camera) -> CameraModel:
    """A COLMAP camera as plain values."""
    params = tuple(map(float, camera.params))
    return CameraModel(camera.model_name, camera.width, camera.height, params)


def flat_camera(camera: CameraModel) -> Camera:
    """The pinhole camera, at the origin, of what `undistort` makes of a photograph."""
    return to_pinhole(plain_camera(_pinhole_of(camera)) if camera.distorted else camera)


def undistort(image: ByteArray, camera: CameraModel) -> tuple[ByteArray, Camera]:
    """Undistort one image [H, W, 3] of any perspective COLMAP camera model; its size changes.

    Raises `InputError` for a camera without a pinhole image (a full panorama) or with impossible
    parameters.
    """
    import pycolmap

    bitmap = pycolmap.Bitmap.from_array(np.ascontiguousarray(image))
    flat, pinhole = _undistorted(camera, pycolmap.undistort_image, bitmap)
    return np.array(flat.to_array()), to_pinhole(plain_camera(pinhole))


def plain_camera(camera: pycolmap.Camera) -> CameraModel:
    """A COLMAP camera as plain values, as PINHOLE if a pinhole projects as it does.

    Projections are compared, not coefficients: a fisheye with zero coefficients is no pinhole,
    while FULL_OPENCV with coefficients that cancel, FOV with an angle near 0 and EUCM with alpha =
    0 are. SIMPLE_PINHOLE stays as it is.
    """
    values = as_values(camera)
    # pycolmap's focal lengths of a panorama are not defined; asking for them ends the process.
    if not values.distorted or camera.is_spherical():
        return values
    if not largest_distortion(camera) <= MAX_IGNORED_DISTORTION:  # also for NaN
        return values
    return replace(values, name="PINHOLE", params=tuple(_pinhole_parameters(camera)))


def largest_distortion(camera: pycolmap.Camera) -> float:
    """The largest distance in px between a camera's projections and those of its pinhole.

    It is measured along the pinhole's rays through a grid of pixels that covers the image. The
    result is NaN if the camera does not see one of these rays.
    """
    pixels = grid(np.linspace(0, camera.width, GRID), np.linspace(0, camera.height, GRID))
    rays = rays_through(pixels, *_pinhole_parameters(camera))
    projected = np.asarray(camera.img_from_cam(rays), dtype=np.float64)
    return float(np.linalg.norm(projected - pixels, axis=1).max())


def folded_share(camera: pycolmap.Camera, pinhole: pycolmap.Camera) -> float:
    """The share of the undistorted image in which the lens model turns back.

    A polynomial of few terms may fall again outside the region where it was measured. From there
    on, an undistorted image repeats its inner part, mirrored. So for a ray there, as for one that
    the camera does not see, COLMAP does not find the ray again from the place where it is seen.
    """
    middles = np.arange(FOLD_GRID) + 0.5
    pixels = grid(middles * pinhole.width / FOLD_GRID, middles * pinhole.height / FOLD_GRID)
    parameters = _pinhole_parameters(pinhole)
    rays = rays_through(pixels, *parameters)
    seen: Any = camera.img_from_cam(rays)
    found: Any = camera.cam_from_img(seen)  # [P, 2]
    misses = np.linalg.norm((found - rays[:, :2]) * parameters[:2], axis=1)  # px
    return float((~(misses < 1)).mean())  # NaN is lost too


def grid(columns: Array, rows: Array) -> Array:
    """All pairs [P, 2] of the coordinates, row by row."""
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def rays_through(pixels: Array, fx: float, fy: float, cx: float, cy: float) -> Array:
    """The rays [P, 3] of a pinhole camera through pixels [P, 2], on the plane at distance 1."""
    return np.column_stack([(pixels - (cx, cy)) / (fx, fy), np.ones(len(pixels))])


def _pinhole_parameters(camera: pycolmap.Camera) -> list[float]:
    return [
        camera.focal_length_x,
        camera.focal_length_y,
        camera.principal_point_x,
        camera.principal_point_y,
    ]
