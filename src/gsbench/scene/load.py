"""Loading of a `Scene` from a capture and the COLMAP model of its initialisation: pinhole cameras, final size.

Prepared images are kept below ``cache_dir`` as PNG files, each set in a folder named after all that it depends on and
published by one rename, so a set is either whole or absent. Images that need no change are read from where they lie.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import secrets
import shutil
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from gsbench.errors import InputError
from gsbench.logs import Progress, no_progress
from gsbench.scene.camera import Camera
from gsbench.scene.colmap_files import model_files
from gsbench.scene.images import Resample, check_size, image_size, read_image
from gsbench.scene.masks import Mask, read_mask
from gsbench.scene.names import MIN_IMAGES
from gsbench.scene.prepare import CameraModel, Job, mask_file, pinhole_of, prepare_all
from gsbench.scene.sizes import downscaled_size
from gsbench.scene.types import Capture, Scene, View
from gsbench.words import some_of

log = logging.getLogger(__name__)

PrincipalPoint = Literal["used", "centred"]
CACHE_VERSION = 1  # raise when prepared pixels or the file below change
CAMERAS_FILE = "cameras.json"
INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")


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
    folder = Path(cache_dir) / _cache_key(capture, Path(model_dir), downscale, max_size, resample, made_by)
    if not (folder / CAMERAS_FILE).is_file():
        _build(folder, capture, Path(model_dir), downscale, max_size, resample, threads, progress)
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


def _build(
    folder: Path,
    capture: Capture,
    model_dir: Path,
    downscale: int,
    max_size: int | None,
    resample: Resample,
    threads: int,
    progress: Progress,
) -> None:
    """Prepare all registered images of the capture and publish them as ``folder``."""
    cameras = _model_cameras(capture, model_dir)
    folder.parent.mkdir(parents=True, exist_ok=True)
    work = folder.parent / f".{folder.name}-{secrets.token_hex(4)}"
    work.mkdir()  # not mkdtemp, whose folders nobody else may read: a cache may be shared
    try:
        entries: dict[str, dict[str, object]] = {}
        jobs: dict[str, Job] = {}
        for index, (name, (model, pose)) in enumerate(cameras.items()):
            size = (model.width, model.height)
            changed = model.distorted or downscaled_size(*size, downscale, max_size) != size
            file = f"{index:05d}.png" if changed else ""
            entries[name] = {"file": file, "pose": pose}
            if changed:
                mask = capture.masks.get(name)
                jobs[name] = Job(capture.images / name, model, work / file, downscale, max_size, resample, mask)
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


def _cache_key(
    capture: Capture,
    model_dir: Path,
    downscale: int,
    max_size: int | None,
    resample: Resample,
    made_by: Mapping[str, str | None],
) -> str:
    """A digest of the images, the model's cameras and poses, the options, and what prepares the images."""
    digest = hashlib.sha256()
    for file in sorted(model_files(model_dir)):
        if file.stem != "points3D":
            digest.update(f"{file.name}\0{hashlib.sha256(file.read_bytes()).hexdigest()}\n".encode())
    options = [CACHE_VERSION, capture.fingerprint, capture.image_names, downscale, max_size, resample]
    options += [sorted(made_by.items())]
    digest.update(json.dumps(options).encode())
    return digest.hexdigest()[:32]
