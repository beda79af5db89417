"""Preparation of a photograph on disk: an undistorted image at its final size, one file at a time.

Undistortion is COLMAP's own with the defaults of its ``image_undistorter``, which INRIA's ``convert.py`` uses too: the
largest pinhole image without blank pixels, at the focal length of the original. It runs on pixels in memory, so nothing
passes through JPEG again.
"""

from __future__ import annotations

import zlib  # noqa: F401  must be loaded before pycolmap, whose own zlib otherwise crashes Pillow's PNG code
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsbench.errors import InputError
from gsbench.logs import Progress, no_progress
from gsbench.scene.camera import Camera
from gsbench.scene.images import Resample, read_image, resize_image
from gsbench.scene.masks import WHITE, read_mask, resize_mask, write_mask
from gsbench.scene.sizes import downscaled_size
from gsbench.system.isolate import CrashError, run_isolated

PINHOLE_NAMES = ("SIMPLE_PINHOLE", "PINHOLE")
_PNG_COMPRESSION = 1  # zlib level: lossless at any level, and this one writes about five times as fast as the default
_CHUNK = 16  # images per isolated process: bounds what a crash loses, and lets progress be reported


@dataclass(frozen=True)
class CameraModel:
    """A COLMAP camera as plain values: the model's name, the size in px, and the parameters in COLMAP's order."""

    name: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def distorted(self) -> bool:
        return self.name not in PINHOLE_NAMES


@dataclass(frozen=True)
class Job:
    """One image to prepare: where it is, its camera (of the file's size), and the PNG to write.

    The ``mask``, where there is one, is prepared with it, into `mask_file` beside the target.
    """

    source: Path
    camera: CameraModel
    target: Path
    downscale: int = 1
    max_size: int | None = None
    resample: Resample = "lanczos"
    mask: Path | None = None


def mask_file(image_file: str) -> str:
    """The name of the prepared mask of a prepared image."""
    return Path(image_file).with_suffix(".mask.png").name


def pinhole_of(camera: CameraModel) -> Camera:
    """An undistorted COLMAP camera as a `Camera` at the origin."""
    fx, fy, cx, cy = camera.params if camera.name == "PINHOLE" else (camera.params[0], *camera.params)
    return Camera(camera.width, camera.height, fx, fy, cx, cy, np.eye(3), np.zeros(3))


def prepare_all(jobs: Sequence[Job], threads: int = 2, progress: Progress = no_progress) -> list[Camera]:
    """Prepare all images and return their final cameras, at the origin, in the order of ``jobs``.

    Distorted images go through child processes, because COLMAP's native code can abort the process it runs in; such an
    abort, like an unreadable image, raises `InputError`. ``progress`` counts images.
    """
    results: list[Camera] = []
    for chunk in _chunks(jobs):
        if any(job.camera.distorted for job in chunk):
            try:
                results += run_isolated(prepare_chunk, chunk, threads, what="undistortion")
            except CrashError as error:
                names = f"{chunk[0].source} to {chunk[-1].source.name}"
                raise InputError(f"{error} ({names}): check these images and their cameras") from error
        else:
            results += prepare_chunk(chunk, threads)
        progress("views", len(results), len(jobs))
    return results


def prepare_chunk(jobs: Sequence[Job], threads: int) -> list[Camera]:
    """Prepare some images in this process."""
    with ThreadPoolExecutor(max_workers=max(1, threads)) as pool:
        return list(pool.map(prepare_image, jobs))


def prepare_image(job: Job) -> Camera:
    """Read, undistort if needed, downscale, and write one image as PNG; returns its final camera, at the origin."""
    image = read_image(job.source)  # [H, W, 3]
    if image.shape[:2] != (job.camera.height, job.camera.width):
        raise InputError(f"{job.source}: the image changed its size while it was read: run again")
    if job.camera.distorted:
        image, camera = undistort(image, job.camera)
    else:
        camera = pinhole_of(job.camera)
    width, height = downscaled_size(camera.width, camera.height, job.downscale, job.max_size)
    image = resize_image(image, width, height, job.resample)
    job.target.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(job.target, format="PNG", compress_level=_PNG_COMPRESSION)
    if job.mask is not None:
        _prepare_mask(job.mask, job, width, height)
    return camera.resized(width, height)


def _prepare_mask(source: Path, job: Job, width: int, height: int) -> None:
    """Write the mask as the image is: a pixel counts where nothing ignored is mixed into its own area."""
    counts = read_mask(source)
    if job.camera.distorted:
        levels = np.repeat(counts[..., None].astype(np.uint8) * WHITE, 3, axis=2)  # [H, W, 3]
        counts = undistort(levels, job.camera)[0][..., 0] == WHITE
    counts = resize_mask(counts, width, height)
    if not counts.any():
        raise InputError(f"{source}: no pixel is left that counts at {width}x{height} px: leave its image out")
    write_mask(counts, job.target.with_name(mask_file(job.target.name)))


def undistort(image: NDArray[np.uint8], camera: CameraModel) -> tuple[NDArray[np.uint8], Camera]:
    """Undistort one image [H, W, 3] of any perspective COLMAP camera model; its size changes.

    Raises `InputError` for a camera that has no pinhole image (a full panorama) or nonsensical parameters.
    """
    import pycolmap  # here, because pinhole images need none of it

    source = pycolmap.Camera(
        camera_id=1, model=camera.name, width=camera.width, height=camera.height, params=list(camera.params)
    )
    refusal = (
        f"images of the camera model {camera.name} with parameters {camera.params} cannot be made pinhole images: "
        "use another camera model"
    )
    if source.is_spherical():
        raise InputError(refusal)
    bitmap = pycolmap.Bitmap.from_array(np.ascontiguousarray(image))
    try:
        flat, pinhole = pycolmap.undistort_image(pycolmap.UndistortCameraOptions(), bitmap, source)
    except (ValueError, RuntimeError) as error:
        raise InputError(refusal) from error
    params = tuple(float(value) for value in pinhole.params)
    return np.array(flat.to_array()), pinhole_of(CameraModel("PINHOLE", pinhole.width, pinhole.height, params))


def _chunks(jobs: Sequence[Job]) -> Iterator[Sequence[Job]]:
    for start in range(0, len(jobs), _CHUNK):
        yield jobs[start : start + _CHUNK]
