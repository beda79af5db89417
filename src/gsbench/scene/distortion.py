"""Deciding which COLMAP cameras are pinholes in effect, whatever the name of their camera model.

Many exporters write photographs that are undistorted already under a model with distortion whose
coefficients are zero. Undistorting these again would resample every pixel for nothing.
"""

import numpy as np
import pycolmap
from numpy.typing import NDArray

# A camera whose projection differs nowhere in the image by more than this (px) from a pinhole's
# counts as a pinhole. The limit is a tenth of the reprojection error of a good COLMAP model (.3 to
# .5 px), so poses are less precise than that. Resampling costs more: it shifts the grid by up to
# half a pixel and averages neighbours.
MAX_IGNORED_DISTORTION = 0.05
GRID = 33  # points per side at which the distance is measured, borders included
FOLD_GRID, FOLD_STEPS = 40, 40  # pixels per side and steps towards each for `folded_share`
FOLD_MOVE = 1e-5  # of a ray on the plane at distance 1, for its derivatives


def without_distortion(camera: pycolmap.Camera) -> pycolmap.Camera:
    """The PINHOLE camera that projects as ``camera`` does, or ``camera`` itself if no pinhole does.

    Projections are compared, not coefficients: a fisheye with zero coefficients is no pinhole,
    while FULL_OPENCV with coefficients that cancel, FOV with an angle near 0 and EUCM with alpha =
    0 are. SIMPLE_PINHOLE stays as it is.
    """
    # pycolmap's focal lengths of a panorama are not defined; asking for them ends the process.
    if (
        camera.model in (pycolmap.CameraModelId.PINHOLE, pycolmap.CameraModelId.SIMPLE_PINHOLE)
        or camera.is_spherical()
    ):
        return camera
    if not largest_distortion(camera) <= MAX_IGNORED_DISTORTION:  # also for NaN
        return camera
    pinhole = pycolmap.Camera(
        camera_id=camera.camera_id,
        model=pycolmap.CameraModelId.PINHOLE,
        width=camera.width,
        height=camera.height,
        params=_pinhole_parameters(camera),
    )
    pinhole.has_prior_focal_length = camera.has_prior_focal_length
    return pinhole


def largest_distortion(camera: pycolmap.Camera) -> float:
    """The largest distance in px between a camera's projections and those of its pinhole.

    It is measured along the pinhole's rays through a grid of pixels that covers the image. The
    result is NaN if the camera does not see one of these rays.
    """
    columns, rows = np.meshgrid(
        np.linspace(0, camera.width, GRID), np.linspace(0, camera.height, GRID)
    )
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)  # [P, 2]
    fx, fy, cx, cy = _pinhole_parameters(camera)
    rays = np.column_stack([(pixels - (cx, cy)) / (fx, fy), np.ones(len(pixels))])  # [P, 3]
    projected = np.asarray(camera.img_from_cam(rays), dtype=np.float64)
    return float(np.linalg.norm(projected - pixels, axis=1).max())


def folded_share(camera: pycolmap.Camera, pinhole: pycolmap.Camera) -> float:
    """The share of the undistorted image in which the lens model turns back.

    A polynomial of few terms may fall again outside the region where it was measured. From there
    on, an undistorted image repeats its inner part, mirrored. Along lines from the principal point
    to each pixel of ``pinhole``, the mapping must keep its orientation; from the first place where
    it does not, or where the camera sees no ray, the line is lost.
    """
    fx, fy, cx, cy = _pinhole_parameters(pinhole)
    columns, rows = np.meshgrid(
        (np.arange(FOLD_GRID) + 0.5) * pinhole.width / FOLD_GRID,
        (np.arange(FOLD_GRID) + 0.5) * pinhole.height / FOLD_GRID,
    )
    ends = np.stack([(columns.ravel() - cx) / fx, (rows.ravel() - cy) / fy], axis=1)  # [P, 2]
    rays = ends[:, None] * (np.arange(1, FOLD_STEPS + 1) / FOLD_STEPS)[:, None]  # [P, S, 2]

    def project(offset: tuple[float, float]) -> NDArray[np.float64]:
        moved = (rays + offset).reshape(-1, 2)
        pixels = camera.img_from_cam(np.column_stack([moved, np.ones(len(moved))]))
        return np.asarray(pixels, dtype=np.float64).reshape(rays.shape)

    origin = project((0.0, 0.0))
    along_x, along_y = (project(move) - origin for move in ((FOLD_MOVE, 0.0), (0.0, FOLD_MOVE)))
    orientation = along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]  # [P, S]
    return float((~(orientation > 0)).any(axis=1).mean())  # NaN is lost too


def _pinhole_parameters(camera: pycolmap.Camera) -> list[float]:
    return [
        camera.focal_length_x,
        camera.focal_length_y,
        camera.principal_point_x,
        camera.principal_point_y,
    ]
