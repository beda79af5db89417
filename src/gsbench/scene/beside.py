"""Pictures beside photographs, such as a sensor's depth, as pixels of the trained views.

``scene.beside`` names them. Losses, terms and densifiers read them (docs/ideas.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.files import DAMAGE, file_sha256
from gsbench.scene.images import open_image
from gsbench.scene.types import Camera, CameraModel, Capture
from gsbench.scene.undistortion import as_colmap, grid, rays_through
from gsbench.words import listed

DEPTH = "depth"
MILLIMETRE = 0.001  # of a world in metres: the step of most sensors
Pixels = NDArray[Any]  # [H, W] or [H, W, C]


def files_beside(capture: Capture, kinds: Sequence[str]) -> dict[str, Mapping[str, Path]]:
    """The files of each kind by photograph; raises InputError for a kind that none has."""
    for kind in kinds:
        if kind not in capture.beside:
            raise InputError(
                f"scene.beside={kind}: no photograph of {capture.images} has such a picture; there "
                f"are: {listed(sorted(capture.beside)) or 'none'}; put them into a folder beside "
                "the photographs', named like this and like a kind of picture (docs/captures.md)"
            )
    return {kind: capture.beside[kind] for kind in kinds}


def read_beside(path: Path, kind: str, depth_scale: float | None = None) -> Pixels:
    """The pixels of a file: depth in world units [H, W] float32, others uint8 [H, W, C].

    Depth is ``.npy`` with float32 values, or a picture of one channel; integers are steps of
    ``depth_scale`` world units (None: a thousandth). Values that are not finite and above 0 become
    0, which means that the depth is not known. Raises InputError for a file that cannot be read.
    """
    if kind != DEPTH:
        with open_image(path, decode=True) as image:
            return np.atleast_3d(np.asarray(image))
    if path.suffix.lower() == ".npy":
        try:
            values: Pixels = np.load(path, allow_pickle=False)
        except DAMAGE as error:
            raise InputError(f"{path}: is no array of numpy ({error}): save it again") from error
    else:
        with open_image(path, decode=True) as image:
            values = np.asarray(image)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2 or values.dtype.kind not in "uif":
        raise InputError(
            f"{path}: a depth map has one number for each pixel, this has {values.dtype} "
            f"{list(values.shape)}: save it as 16-bit grey, 32-bit float TIFF, or .npy of height x "
            "width"
        )
    step = 1.0 if values.dtype.kind == "f" else depth_scale or MILLIMETRE
    depth = values.astype(np.float32) * np.float32(step)
    known = np.isfinite(depth) & (depth > 0)
    return np.where(known, depth, 0).astype(np.float32)


def resized(picture: Pixels, width: int, height: int) -> Pixels:
    """The nearest pixels of a picture [h, w, …] at another size in px: [height, width, …].

    Nothing is interpolated: a mean of two depths belongs to no surface.
    """
    rows = (np.arange(height) + 0.5) * picture.shape[0] / height
    columns = (np.arange(width) + 0.5) * picture.shape[1] / width
    return picture[np.ix_(rows.astype(int), columns.astype(int))]


def pixels_of_view(picture: Pixels, lens: CameraModel, view: Camera, source: Path) -> Pixels:
    """The pixels of ``picture`` [h, w, …] nearest to those of an undistorted view: [H, W, …].

    The picture covers the photograph of ``lens`` and may have another size. Pixels of the view that
    lie outside the photograph are 0. Raises InputError that names ``source``, the picture's file,
    if the picture has another shape.
    """
    height, width = picture.shape[:2]
    # Both sides of a smaller picture were rounded to whole pixels.
    if abs(width * lens.height - height * lens.width) > max(lens.width, lens.height):
        raise InputError(
            f"{source}: is {width}x{height} px, and its photograph {lens.width}x{lens.height}: "
            "give a picture of the whole photograph, of the same shape"
        )
    if not lens.distorted:
        return resized(picture, view.width, view.height)
    middles = [np.arange(side, dtype=np.float64) + 0.5 for side in (view.width, view.height)]
    pixels = grid(*middles)  # [H W, 2]
    rays = rays_through(pixels, view.fx, view.fy, view.cx, view.cy)
    seen: Any = as_colmap(lens).img_from_cam(rays)  # [H W, 2] px
    places = seen / (lens.width, lens.height)  # in 0..1
    inside = ((places >= 0) & (places < 1)).all(axis=1)  # False for a ray without a place
    across, down = (np.where(inside[:, None], places, 0) * picture.shape[1::-1]).astype(int).T
    chosen = picture[down, across]
    chosen[~inside] = 0
    return chosen.reshape(view.height, view.width, *picture.shape[2:])


def view_of_file(
    path: Path, kind: str, lens: CameraModel, view: Camera, depth_scale: float | None = None
) -> Pixels:
    """`pixels_of_view` of the file ``path``, as `read_beside` reads it."""
    return pixels_of_view(read_beside(path, kind, depth_scale), lens, view, path)


def digests(files: Mapping[str, Mapping[str, Path]]) -> dict[str, dict[str, str]]:
    """sha256 of each file, by kind and photograph."""
    return {
        kind: {name: file_sha256(path) for name, path in sorted(own.items())}
        for kind, own in files.items()
    }
