"""The photographs of a trial and its initial cloud.

Photographs are read from the user's folder, masked, and resized to views; the test views are kept
as PNG.
"""

from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsbench.files import file_sha256
from gsbench.init.base import MODEL_FOLDER, Initializer
from gsbench.init.placed import GREY
from gsbench.init.point_files import read_points
from gsbench.logs import Progress, progress
from gsbench.normalization import IDENTITY
from gsbench.runs.code import NO_USER_CODE, UserCode
from gsbench.runs.configuration import sha256_of
from gsbench.runs.keys import CAPTURE, GROUND_TRUTH, INIT, Step, options_of, step_of
from gsbench.runs.layout import MASKS
from gsbench.runs.store import Store
from gsbench.scene.beside import (
    IMAGES,
    digests,
    files_beside,
    prepare_photograph,
    prepared_mask,
    write_mask,
)
from gsbench.scene.colmap import Cloud, normalize_capture, write_frames
from gsbench.scene.colmap_files import SPARSE_FOLDERS
from gsbench.scene.courtyard.render import render_courtyard
from gsbench.scene.images import png_name, read_image
from gsbench.scene.load import load_scene
from gsbench.scene.options import Backdrop, SceneConfig
from gsbench.scene.pipe import fingerprint, prepare
from gsbench.scene.readers import existing_folder, read_raw
from gsbench.scene.record import PointsFile, RawCapture, SceneReader
from gsbench.scene.rules import inspect
from gsbench.scene.twins import without_copies
from gsbench.scene.types import Capture, Scene, View
from gsbench.system.install import version_of
from gsbench.system.resources import in_threads


class CaptureSource:
    """The source of the photographs of a scene: the user's folder, or a step that makes them."""

    def __init__(
        self,
        options: SceneConfig,
        reader: SceneReader | None = None,
        user: UserCode = NO_USER_CODE,
    ) -> None:
        self.options, self._reader, self._user = options, reader, user

    @cached_property
    def step(self) -> Step | None:
        """The step that makes the photographs, or a COLMAP model of their cameras.

        None for photographs without cameras, or whose model can be used as it is.
        """
        if self.options.kind == "courtyard":
            return _courtyard_step(self.options)
        if self._raw.model is not None or not self._raw.has_cameras:
            return None
        own = self._reader
        reader = None if own is None else options_of("scene", own, self._user)
        return _cameras_step(self._raw, reader)

    def read(self, made: Path | None) -> Capture:
        """The photographs, selected and split; ``made`` is the folder that ``step`` filled."""
        if self.options.kind == "courtyard":
            assert made is not None
            raw = read_raw(made, self.options)
            return prepare(raw, self.options, made, raw.model)
        model = self._raw.model if made is None else made / SPARSE_FOLDERS[0]
        return prepare(self._raw, self.options, self._root, model)

    @property
    def _root(self) -> Path:
        return existing_folder(str(self.options.name), self.options.path)

    @cached_property
    def _raw(self) -> RawCapture:
        return read_raw(self._root, self.options, self._reader)


def _courtyard_step(options: SceneConfig) -> Step:
    inputs = {name: getattr(options, name) for name in ("views", "width", "height", "seed")}

    def build(folder: Path) -> None:
        with progress("scene") as report:
            render_courtyard(folder, progress=report, **inputs)

    return step_of(CAPTURE, inputs, build)


def _cameras_step(raw: RawCapture, reader: dict[str, Any] | None) -> Step:
    """The step that writes the cameras and points of a capture as a COLMAP model.

    ``reader`` has the class, options and code of a user's reader.
    """
    frames = {row.name: row.posed for row in raw.photographs}
    cameras = {
        name: [asdict(camera), rotation.tolist(), translation.tolist()]
        for name, (camera, rotation, translation) in frames.items()
    }
    inputs: dict[str, Any] = {
        "reader": reader,
        "files": [file_sha256(file) for file in raw.files],
        "cameras": sha256_of(cameras),
    }
    if isinstance(raw.points, tuple):
        inputs["points"] = sha256_of([values.tolist() for values in raw.points])

    def build(target: Path) -> None:
        write_frames(target / SPARSE_FOLDERS[0], frames, cloud=_cloud(raw))

    return step_of(CAPTURE, inputs, build)


def _cloud(raw: RawCapture) -> Cloud | None:
    if not isinstance(raw.points, PointsFile):
        return raw.points
    points, colors = read_points(raw.points.path)
    grey = np.full(points.shape, GREY, dtype=np.uint8)
    return raw.points.applied.undo(points), grey if colors is None else colors


def masking_step(capture: Capture, backdrop: Backdrop) -> Step | None:
    """The step that replaces masked and transparent pixels before any other step sees them.

    None for a capture without masks if transparent pixels become black, because reading an image
    makes them black anyway.
    """
    if not capture.masks and backdrop == "black":
        return None
    inputs: dict[str, Any] = {
        "images": fingerprint(capture.images, capture.image_names),
        "masks": {name: file_sha256(file) for name, file in sorted(capture.masks.items())},
        "ignored": "as the nearest counted pixel",
    }
    if backdrop != "black":
        inputs["behind"] = backdrop

    def build(folder: Path) -> None:
        names = capture.image_names

        def prepare(name: str) -> None:
            prepare_photograph(folder, capture.images, capture.masks, name, backdrop)

        with progress("scene") as report:
            for done, _ in enumerate(in_threads(prepare, names), 1):
                report("pixels replaced", done, len(names))

    return step_of(CAPTURE, inputs, build)


def masked_capture(capture: Capture, folder: Path) -> Capture:
    """The capture with the images and masks that `masking_step` left in ``folder``."""
    masks = {name: prepared_mask(folder, name) for name in capture.masks}
    return replace(capture, images=folder / IMAGES, masks=masks)


def normalizing_step(capture: Capture) -> Step | None:
    """The step that moves the model to the coordinates of the training; None if they are the same.

    It comes before the initialisation, so triangulation and the reading of points work there too.
    """
    if capture.advised_normalization.is_identity:
        return None
    inputs = {
        "capture": capture.fingerprint,
        "normalization": asdict(capture.advised_normalization),
    }
    return step_of(
        CAPTURE, inputs, lambda folder: normalize_capture(capture, folder / MODEL_FOLDER)
    )


def normalized_capture(capture: Capture, step: Step, folder: Path) -> Capture:
    """The capture with the model that ``step``, a `normalizing_step`, left in ``folder``."""
    return replace(
        capture,
        model=folder / MODEL_FOLDER,
        fingerprint=step.key,
        normalization=capture.advised_normalization,
        advised_normalization=IDENTITY,
    )


class Views:
    """The views of a trial, loaded at their first use, and what they depend on."""

    def __init__(self, store: Store, capture: Capture, init: Step, options: SceneConfig) -> None:
        self.store, self.capture, self.init = store, capture, init
        names = ("max_size", "principal_point")
        self.preparation: dict[str, Any] = {name: getattr(options, name) for name in names}
        self._beside: dict[str, Any] = {}
        if options.beside:
            self._beside = {"beside": options.beside, "depth_scale": options.depth_scale}

    @cached_property
    def inputs(self) -> dict[str, Any]:
        """The inputs on which the views depend, besides the cameras, which come from ``init``."""
        names = sha256_of(list(self.capture.test_names))
        inputs = {"capture": self.capture.fingerprint, "test": names, **self.preparation}
        if not self._beside:  # so that earlier keys stay
            return inputs
        files = files_beside(self.capture, self._beside["beside"])
        return inputs | self._beside | {"beside": digests(files)}

    @cached_property
    def scene(self) -> Scene:
        """The undistorted, shrunk views, without training views that are copies of test views.

        ``init`` must be built. Prepared images are cached in the store.
        """
        with progress("scene") as report:
            scene = load_scene(
                self.capture,
                self.store.path(self.init) / MODEL_FOLDER,
                self.store,
                progress=report,
                **self.preparation,
                **self._beside,
            )
        scene = without_copies(scene)
        odd = inspect("scene", scene, f"scene {scene.name}", self.capture.accept)
        return replace(scene, oddities=scene.oddities + odd)


def ground_truth_step(views: Views) -> Step:
    """The step that keeps the test views, and the masks of those that have one, as PNG files."""

    def build(folder: Path) -> None:
        def write(view: View) -> None:
            Image.fromarray(view.image).save(folder / png_name(view.name))
            if view.mask is not None:
                (folder / MASKS).mkdir(exist_ok=True)
                write_mask(view.mask, folder / MASKS / png_name(view.name))

        for _ in in_threads(write, views.scene.test):
            pass

    return step_of(GROUND_TRUTH, {"scene": views.inputs, "init": views.init.key}, build)


# ---- initialisation: cameras and the first cloud, shared by all trials with the same options


def init_step(
    store: Store,
    capture: Capture,
    initializer: Initializer,
    reference: Step | None = None,
    user: UserCode = NO_USER_CODE,
) -> Step:
    """The step that runs the initialiser.

    ``reference`` is the step that reconstructs cameras for a capture without them.
    """
    inputs = {
        "capture": capture.fingerprint,
        "test": sha256_of(list(capture.test_names)),
        "exact_poses": capture.exact_poses,
        "options": options_of("init", initializer, user),
        "content": initializer.content(),
        "reference": None if reference is None else reference.key,
        "pycolmap": version_of("pycolmap"),
    }

    def build(folder: Path) -> None:
        with progress("init") as report:
            check_readable(capture, report)
            cameras = None if reference is None else store.path(reference) / MODEL_FOLDER
            initializer.run(capture, folder, report, reference=cameras)

    return step_of(INIT, inputs, build, user, in_processes=True)


def check_readable(capture: Capture, report: Progress) -> None:
    """Decode every photograph once; raises InputError for a damaged one before hours of work."""
    names = capture.image_names
    read = in_threads(lambda name: read_image(capture.images / name).shape, names)
    for done, _ in enumerate(read, 1):
        report("photographs", done, len(names))
