"""Loading of a `Scene` from a capture and the COLMAP model of its initialisation: pinhole cameras, final size.

Prepared images are kept below ``cache_dir`` as PNG files, each set in a folder named after all that it depends on and
published by one rename, so a set is either whole or absent. Images that need no change are read from where they lie.

Undistortion is COLMAP's own with the defaults of its ``image_undistorter``, which INRIA's ``convert.py`` uses too: the
largest pinhole image without blank pixels, at the focal length of the original. It runs on pixels in memory, so nothing
passes through JPEG again.
"""

import hashlib
import json
import logging
import os
import secrets
import shutil
import zlib  # noqa: F401  must be loaded before pycolmap, whose own zlib otherwise crashes Pillow's PNG code
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsbench.errors import InputError
from gsbench.logs import Progress, no_progress
from gsbench.scene.camera import Camera, CameraModel, pinhole_of
from gsbench.scene.colmap_files import model_files
from gsbench.scene.images import Resample, check_size, image_size, read_image, resize_image
from gsbench.scene.masks import WHITE, Mask, read_mask, resize_mask, write_mask
from gsbench.scene.names import MIN_IMAGES
from gsbench.scene.options import downscaled_size
from gsbench.scene.types import Capture, Scene, View
from gsbench.system.isolate import CrashError, run_isolated
from gsbench.words import some_of

log = logging.getLogger(__name__)

PrincipalPoint = Literal["used", "centred"]
CACHE_VERSION = 1  # raise when prepared pixels or the file below change
CAMERAS_FILE = "cameras.json"
INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")
_PNG_COMPRESSION = 1  # zlib level: lossless at any level, and this one writes about five times as fast as the default
_CHUNK = 16  # images per isolated process: bounds what a crash loses, and lets progress be reported


@dataclass(frozen=True)
class Size:
    """Settings of shrinking images: see `downscaled_size`."""

    downscale: int = 1
    max_size: int | None = None
    resample: Resample = "lanczos"

    def of(self, width: int, height: int) -> tuple[int, int]:
        """The size of an image of ``width`` x ``height`` px when it is shrunk."""
        return downscaled_size(width, height, self.downscale, self.max_size)


def load_scene(
    capture: Capture,
    model_dir: Path,
    cache_dir: Path,
    downscale: int = 1,
    max_size: int | None = None,
    resample: Resample = "lanczos",
    principal_point: PrincipalPoint = "used",
    threads: int = 2,
    progress: Progress = no_progress,
    made_by: Mapping[str, str | None] = MappingProxyType({}),
) -> Scene:
    """Load the views of a capture with the cameras of the COLMAP model in ``model_dir``.

    Images of a distorted camera are undistorted, then all are shrunk by ``downscale`` and to a longest side of
    ``max_size`` px (see `downscaled_size`). ``centred`` moves principal points to the image centre, as 3DGS assumes.
    Views without a pose in the model are left out with a warning. ``progress`` counts images. ``made_by`` names the
    versions of code and packages that prepare images, so that those of others are not taken from the cache.

    Raises `InputError` if fewer than three views or no training view have a pose, or an image does not fit its camera.
    """
    if principal_point not in ("used", "centred"):
        raise InputError(f"scene.principal_point must be used or centred, got {principal_point!r}")
    size = Size(downscale, max_size, resample)
    folder = Path(cache_dir) / _cache_key(capture, Path(model_dir), size, made_by)
    if not (folder / CAMERAS_FILE).is_file():
        _build(folder, capture, Path(model_dir), size, threads, progress)
    entries = json.loads((folder / CAMERAS_FILE).read_text(encoding="utf-8"))["views"]
    _report_unregistered(capture, set(entries))

    def mask_of(name: str) -> Mask | None:
        if name not in capture.masks:
            return None
        file = entries[name]["file"]
        counts = read_mask(folder / mask_file(file) if file else capture.masks[name])
        return None if counts.all() else counts

    def view(name: str) -> View:
        entry = entries[name]
        image = read_image(folder / entry["file"] if entry["file"] else capture.images / name)
        camera = _camera(entry)
        if image.shape[:2] != (camera.height, camera.width):
            raise InputError(f"{folder}: {name} is not as it was prepared: delete this folder and run again")
        if principal_point == "centred":
            camera = replace(camera, cx=camera.width / 2, cy=camera.height / 2)
        return View(name, camera, image, mask_of(name))

    names = [name for name in capture.image_names if name in entries]
    with ThreadPoolExecutor(max_workers=max(1, threads)) as pool:
        views = list(pool.map(view, names))
    held_out = set(capture.test_names)
    return Scene(
        name=capture.name,
        train=tuple(view for view in views if view.name not in held_out),
        test=tuple(view for view in views if view.name in held_out),
    )


def _build(folder: Path, capture: Capture, model_dir: Path, size: Size, threads: int, progress: Progress) -> None:
    """Prepare all registered images of the capture and publish them as ``folder``."""
    cameras = _model_cameras(capture, model_dir)
    folder.parent.mkdir(parents=True, exist_ok=True)
    work = folder.parent / f".{folder.name}-{secrets.token_hex(4)}"
    work.mkdir()  # not mkdtemp, whose folders nobody else may read: a cache may be shared
    try:
        entries: dict[str, dict[str, object]] = {}
        jobs: dict[str, Job] = {}
        for index, (name, (model, pose)) in enumerate(cameras.items()):
            changed = model.distorted or size.of(model.width, model.height) != (model.width, model.height)
            file = f"{index:05d}.png" if changed else ""
            entries[name] = {"file": file, "pose": pose}
            if changed:
                mask = capture.masks.get(name)
                jobs[name] = Job(capture.images / name, model, work / file, size, mask)
            else:
                entries[name] |= _intrinsics(pinhole_of(model))
        for name, camera in zip(jobs, prepare_all(list(jobs.values()), threads, progress), strict=True):
            entries[name] |= _intrinsics(camera)
        document = {"version": CACHE_VERSION, "scene": capture.name, "views": entries}
        (work / CAMERAS_FILE).write_text(json.dumps(document, indent=1), encoding="utf-8")
        _publish(work, folder)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _publish(work: Path, folder: Path) -> None:
    try:
        os.rename(work, folder)
    except OSError:
        if (folder / CAMERAS_FILE).is_file():
            return  # another process was first, with the same content
        shutil.rmtree(folder)  # what is there has lost its cameras file, so it is not a whole set
        os.rename(work, folder)


def _model_cameras(capture: Capture, model_dir: Path) -> dict[str, tuple[CameraModel, list[list[float]]]]:
    """For every image of the capture with a pose: its COLMAP camera at the file's size, and its 3x4 pose."""
    from gsbench.scene.colmap import read_model, rescaled_camera  # not needed when the cache answers

    model = read_model(model_dir)
    wanted = set(capture.image_names)
    cameras = {}
    for image in model.images.values():
        if not image.has_pose or image.name not in wanted:
            continue
        camera = model.cameras[image.camera_id]
        size = image_size(capture.images / image.name)
        check_size(capture.images / image.name, size, (camera.width, camera.height))
        camera = rescaled_camera(camera, *size, camera_id=camera.camera_id)
        plain = CameraModel(camera.model_name, *size, tuple(float(value) for value in camera.params))
        cameras[image.name] = (plain, image.cam_from_world().matrix().tolist())
    if len(cameras) < MIN_IMAGES:
        raise InputError(
            f"scene {capture.name}: {len(cameras)} of {len(wanted)} images have a pose in {model_dir}, but at least "
            f"{MIN_IMAGES} are needed: take more overlapping photos, or another init"
        )
    if not set(cameras) & set(capture.train_names):
        raise InputError(
            f"scene {capture.name}: no training view has a pose in {model_dir}: change the split or the init"
        )
    return dict(sorted(cameras.items()))


def _report_unregistered(capture: Capture, registered: set[str]) -> None:
    for kind, names in (("training", capture.train_names), ("test", capture.test_names)):
        missing = [name for name in names if name not in registered]
        if missing:
            log.warning(
                "scene %s: %d of %d %s views have no pose and are left out: %s",
                capture.name, len(missing), len(names), kind, some_of(missing),
            )  # fmt: skip


def _intrinsics(camera: Camera) -> dict[str, float]:
    return {key: getattr(camera, key) for key in INTRINSICS}


def _camera(entry: dict[str, object]) -> Camera:
    pose = np.array(entry["pose"], dtype=np.float64)  # [3, 4] world to camera
    intrinsics: dict[str, Any] = {key: entry[key] for key in INTRINSICS}
    return Camera(**intrinsics, rotation=pose[:, :3], translation=pose[:, 3])


def _cache_key(capture: Capture, model_dir: Path, size: Size, made_by: Mapping[str, str | None]) -> str:
    """A digest of the images, the model's cameras and poses, the options, and what prepares the images."""
    digest = hashlib.sha256()
    for file in sorted(model_files(model_dir)):
        if file.stem != "points3D":
            digest.update(f"{file.name}\0{hashlib.sha256(file.read_bytes()).hexdigest()}\n".encode())
    options = [CACHE_VERSION, capture.fingerprint, capture.image_names, *vars(size).values(), sorted(made_by.items())]
    digest.update(json.dumps(options).encode())
    return digest.hexdigest()[:32]


@dataclass(frozen=True)
class Job:
    """One image to prepare: where it is, its camera (of the file's size), and the PNG to write.

    The ``mask``, where there is one, is prepared with it, into `mask_file` beside the target.
    """

    source: Path
    camera: CameraModel
    target: Path
    size: Size = Size()
    mask: Path | None = None


def mask_file(image_file: str) -> str:
    """The name of the prepared mask of a prepared image."""
    return Path(image_file).with_suffix(".mask.png").name


def prepare_all(jobs: Sequence[Job], threads: int = 2, progress: Progress = no_progress) -> list[Camera]:
    """Prepare all images and return their final cameras, at the origin, in the order of ``jobs``.

    Distorted images go through child processes, because COLMAP's native code can abort the process it runs in; such an
    abort, like an unreadable image, raises `InputError`. ``progress`` counts images.
    """
    results: list[Camera] = []
    for start in range(0, len(jobs), _CHUNK):
        chunk = jobs[start : start + _CHUNK]
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
    width, height = job.size.of(camera.width, camera.height)
    image = resize_image(image, width, height, job.size.resample)
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
