"""Loading a `Scene` of pinhole cameras and final images from a capture and a COLMAP model.

Prepared images are kept in a store as PNG files, under a key of all that the pixels depend on.
Images that need no change are read from the capture.

Undistortion is COLMAP's, with the defaults of its ``image_undistorter``, which INRIA's
``convert.py`` uses too: the largest pinhole image without blank pixels, at the original focal
length. It runs on pixels in memory, so images are not compressed as JPEG again.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated

import numpy as np
from pydantic import Field

from gsbench.errors import InputError
from gsbench.files import file_sha256, write_json
from gsbench.logs import Progress, no_progress
from gsbench.parsing import MAX_NUMBER, Count, Number, Record, read_typed
from gsbench.runs.keys import VIEWS, Step, step_of
from gsbench.runs.store import Store
from gsbench.runs.trial_record import Oddity
from gsbench.scene.beside import (
    DEPTH,
    WHITE,
    files_beside,
    read_mask,
    resize_mask,
    view_of_file,
    write_mask,
)
from gsbench.scene.colmap_files import model_files
from gsbench.scene.images import read_image, resize_image, write_png
from gsbench.scene.options import PrincipalPoint, downscaled_size, require_enough
from gsbench.scene.rules import inspect, settle
from gsbench.scene.types import Camera, CameraModel, Capture, Scene, View, to_pinhole
from gsbench.scene.undistortion import lens_findings, undistort
from gsbench.system.install import version_of
from gsbench.system.isolate import CrashError, run_isolated
from gsbench.system.resources import in_threads

log = logging.getLogger(__name__)

CAMERAS_FILE = "cameras.json"
# images per isolated process: limits what a crash loses, and progress is reported after each chunk
_CHUNK = 16


Row = tuple[Number, Number, Number, Number]
Length = Annotated[float, Field(gt=0, le=MAX_NUMBER)]


class PreparedView(Record):
    """A view in `CAMERAS_FILE`: its camera and the ``file`` beside it, "" for the photograph."""

    file: Annotated[str, Field(pattern=r"^([0-9]+[.]png)?$")]
    pose: tuple[Row, Row, Row]  # world to camera
    width: Count
    height: Count
    params: tuple[Length, Length, Number, Number]  # fx, fy, cx, cy

    @property
    def camera(self) -> Camera:
        pose = np.array(self.pose, dtype=np.float64)  # [3, 4]
        return Camera(self.width, self.height, *self.params, pose[:, :3], pose[:, 3])


class PreparedViews(Record):
    """The content of `CAMERAS_FILE`."""

    views: dict[str, PreparedView]
    oddities: list[Oddity] = field(default_factory=list)  # of lenses


def load_scene(
    capture: Capture,
    model_dir: Path,
    store: Store,
    max_size: int | None = None,
    principal_point: PrincipalPoint = "used",
    progress: Progress = no_progress,
    beside: Sequence[str] = (),
    depth_scale: float | None = None,
) -> Scene:
    """Load the views of a capture with the cameras of the COLMAP model in ``model_dir``.

    Images of a distorted camera are undistorted. Then all images are shrunk to a longest side of
    ``max_size`` px. ``principal_point="centred"`` moves principal points to the image centre, as
    3DGS assumes. Views without a pose in the model are left out with a warning. ``beside`` are
    kinds of pictures beside the photographs (`gsbench.scene.beside`). ``progress`` counts images.

    Raises `InputError` if fewer than three views or no training view have a pose, or an image does
    not fit its camera.
    """
    folder = store.get(views_step(capture, model_dir, max_size, progress)).path
    prepared = read_typed(folder / CAMERAS_FILE, PreparedViews)
    entries = prepared.views
    oddities = settle(prepared.oddities, f"scene {capture.name}", capture.accept)
    oddities += _inspect_views(capture, entries)

    files = files_beside(capture, beside)
    lenses = lenses_of(model_dir) if files else {}

    def view(name: str) -> View:
        entry = entries[name]
        image = read_image(folder / entry.file if entry.file else capture.images / name)
        camera = entry.camera
        pictures = {
            kind: view_of_file(own[name], kind, lenses[name], camera, depth_scale)
            for kind, own in files.items()
            if name in own
        }
        if DEPTH in pictures:
            pictures[DEPTH] *= np.float32(capture.normalization.scale)
        if image.shape[:2] != (camera.height, camera.width):
            raise InputError(f"{folder}: {name} changed after it was prepared: run again")
        if principal_point == "centred":
            camera = replace(camera, cx=camera.width / 2, cy=camera.height / 2)
        mask = None
        if name in capture.masks:
            file = entry.file and folder / mask_file(entry.file)
            mask = read_mask(file or capture.masks[name])
            mask = None if mask.all() else mask
        return View(name, camera, image, mask, pictures)

    names = [name for name in capture.image_names if name in entries]
    views = list(in_threads(view, names))
    for kind, own in files.items():
        if len(own) < len(names):
            log.warning(
                "scene.beside=%s: only %d of %d photographs have it", kind, len(own), len(names)
            )
    if DEPTH in files and not any(
        view.beside[DEPTH].any() for view in views if DEPTH in view.beside
    ):
        raise InputError(
            "scene.beside=depth: no view has a known depth: depths are finite numbers above 0, in "
            "world units or in steps of scene.depth_scale"
        )
    held_out = set(capture.test_names)
    return Scene(
        name=capture.name,
        train=tuple(view for view in views if view.name not in held_out),
        test=tuple(view for view in views if view.name in held_out),
        oddities=oddities,
    )


def views_step(capture: Capture, model_dir: Path, max_size: int | None, progress: Progress) -> Step:
    """The step that prepares all posed images of the capture; no pixel depends on points.

    Pillow reads and shrinks images, pycolmap undistorts them.
    """
    files = [file for file in sorted(model_files(model_dir)) if file.stem != "points3D"]
    inputs = {
        "capture": capture.fingerprint,
        "names": list(capture.image_names),
        "cameras": {file.name: file_sha256(file) for file in files},
        "max_size": max_size,
        **{package: version_of(package) for package in ("pycolmap", "pillow")},
    }

    def build(folder: Path) -> None:
        cameras: dict[str, Camera] = {}
        changes: dict[str, ImageToPrepare] = {}
        models = _model_cameras(capture, model_dir)
        for index, (name, (lens, _)) in enumerate(models.items()):
            target, mask = folder / f"{index:05d}.png", capture.masks.get(name)
            image = ImageToPrepare(capture.images / name, lens, target, mask, max_size)
            size = lens.width, lens.height
            if lens.distorted or downscaled_size(*size, max_size) != size:
                changes[name] = image
            else:
                cameras[name] = to_pinhole(lens)
        lenses = {name: image.camera for name, image in changes.items() if image.camera.distorted}
        odd = inspect("lens", lens_findings(lenses), f"scene {capture.name}", capture.accept)
        prepared = prepare_all(list(changes.values()), progress)
        cameras |= zip(changes, prepared, strict=True)
        entries = {
            name: {
                "file": changes[name].target.name if name in changes else "",
                "pose": pose,
                **{key: getattr(cameras[name], key) for key in ("width", "height", "params")},
            }
            for name, (_, pose) in models.items()
        }
        found = {"oddities": [one.to_json() for one in odd]} if odd else {}
        write_json(folder / CAMERAS_FILE, {"views": entries} | found)

    return step_of(VIEWS, inputs, build)


def _model_cameras(
    capture: Capture, model_dir: Path
) -> dict[str, tuple[CameraModel, list[list[float]]]]:
    """The COLMAP camera at the file's size and the 3x4 pose of every posed image of the capture."""
    # not needed if the views are cached
    from gsbench.scene.colmap import camera_of_file, plain_camera, posed_images, read_model

    model = read_model(model_dir)
    wanted = set(capture.image_names)
    cameras = {}
    for name, image in posed_images(model).items():
        if name in wanted:
            fitted = camera_of_file(model.cameras[image.camera_id], capture.images / name)
            cameras[name] = plain_camera(fitted), image.cam_from_world().matrix().tolist()
    which = f"of {len(wanted)} of scene {capture.name} have a pose"
    require_enough(len(cameras), model_dir, which, "take more overlapping photos, or another init")
    _inspect_views(capture, cameras)  # before hours of work
    return dict(sorted(cameras.items()))


def lenses_of(model_dir: Path) -> dict[str, CameraModel]:
    """The cameras of a model's posed images, before they are undistorted."""
    from gsbench.scene.colmap import posed_by_name, read_model  # not needed without such pictures

    return {name: lens for name, (lens, *_) in posed_by_name(read_model(model_dir)).items()}


def _inspect_views(capture: Capture, placed: Collection[str]) -> tuple[Oddity, ...]:
    """Judge which views of the capture have a pose."""
    views = SimpleNamespace(
        train=[name for name in capture.train_names if name in placed],
        test=[name for name in capture.test_names if name in placed],
        unplaced=[name for name in capture.image_names if name not in placed],
    )
    return inspect("views", views, f"scene {capture.name}", capture.accept)


@dataclass(frozen=True)
class ImageToPrepare:
    """An image file, its camera at the file's size, and the PNG file to write.

    The ``mask``, if any, is prepared too, and written as `mask_file` beside the target.
    """

    source: Path
    camera: CameraModel
    target: Path
    mask: Path | None = None
    max_size: int | None = None


def mask_file(image_file: str) -> str:
    """The file name of a prepared image's mask."""
    return Path(image_file).with_suffix(".mask.png").name


def prepare_all(images: Sequence[ImageToPrepare], progress: Progress) -> list[Camera]:
    """Prepare all images and return their final cameras, at the origin, in the order of ``images``.

    Distorted images are undistorted in child processes, because COLMAP's native code can abort its
    process. Such an abort raises `InputError`, as an unreadable image does. ``progress`` counts
    images.
    """
    cameras: list[Camera] = []
    for start in range(0, len(images), _CHUNK):
        chunk = images[start : start + _CHUNK]
        if any(image.camera.distorted for image in chunk):
            try:
                cameras += run_isolated(prepare_chunk, chunk, what="undistortion")
            except CrashError as error:
                names = f"{chunk[0].source} to {chunk[-1].source.name}"
                raise InputError(
                    f"{error} ({names}): check these images and their cameras"
                ) from error
        else:
            cameras += prepare_chunk(chunk)
        progress("views", len(cameras), len(images))
    return cameras


def prepare_chunk(images: Sequence[ImageToPrepare]) -> list[Camera]:
    """Prepare some images in this process."""
    return list(in_threads(prepare_image, images))


def prepare_image(image: ImageToPrepare) -> Camera:
    """Read, undistort if needed, shrink and write one image; returns its final camera."""
    pixels = read_image(image.source)  # [H, W, 3]
    if pixels.shape[:2] != (image.camera.height, image.camera.width):
        raise InputError(f"{image.source}: the image changed its size while it was read: run again")
    if image.camera.distorted:
        pixels, camera = undistort(pixels, image.camera)
    else:
        camera = to_pinhole(image.camera)
    width, height = downscaled_size(camera.width, camera.height, image.max_size)
    pixels = resize_image(pixels, width, height)
    image.target.parent.mkdir(parents=True, exist_ok=True)
    write_png(pixels, image.target)
    if image.mask is not None:
        # Treated as the image: a pixel counts if no ignored pixel contributes to its area.
        mask = read_mask(image.mask)
        if image.camera.distorted:
            levels = np.repeat(mask[..., None].astype(np.uint8) * WHITE, 3, axis=2)  # [H, W, 3]
            mask = (undistort(levels, image.camera)[0] == WHITE).all(axis=2)
        mask = resize_mask(mask, width, height)
        if not mask.any():
            raise InputError(
                f"{image.mask}: no pixel is left that counts at {width}x{height} px: leave its "
                "image out"
            )
        write_mask(mask, image.target.with_name(mask_file(image.target.name)))
    return camera.resized(width, height)
