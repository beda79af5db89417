"""The photographs of a trial and its initial cloud.

Photographs are read from the user's folder, masked, and resized to views; the test views are kept
as PNG.
"""

from dataclasses import asdict, replace
from functools import cache, cached_property
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
from gsbench.runs.keys import CAPTURE, CODE_OF_VIEWS, GROUND_TRUTH, INIT, Step, options_of, step_of
from gsbench.runs.layout import MASKS, VIEWS
from gsbench.runs.nested import sha256_of
from gsbench.runs.package_code import edited, states_of
from gsbench.runs.store import Store
from gsbench.runs.user_code import NO_USER_CODE, UserCode
from gsbench.scene.colmap import normalize_capture, write_frames
from gsbench.scene.courtyard.render import render_courtyard
from gsbench.scene.images import image_size, png_name, read_image
from gsbench.scene.load import load_scene
from gsbench.scene.masks import IMAGES, prepare_photograph, prepared_mask, write_mask
from gsbench.scene.model_folders import SPARSE_FOLDERS, require_subfolder
from gsbench.scene.options import Backdrop, SceneConfig, check_final_size
from gsbench.scene.own_reader import PosedImages, SceneReader, read_posed_images
from gsbench.scene.readers import (
    existing_folder,
    fingerprint,
    read_colmap,
    read_photos,
    read_posed,
    read_transforms,
)
from gsbench.scene.transforms import Transforms
from gsbench.scene.transforms import read_transforms as read_transforms_files
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
        self.options, self.name = options, str(options.name)
        self._reader, self._user = reader, user

    @cached_property
    def step(self) -> Step | None:
        """The step that makes the photographs, or a COLMAP model of cameras from other files.

        None for a scene whose folder can be read directly.
        """
        if self.options.kind == "transforms":
            return _transforms_step(self._transforms)
        if self._reader is not None:
            return _reader_step(self._posed, options_of("scene", self._reader, self._user))
        return _courtyard_step(self.options) if self.options.kind == "courtyard" else None

    def read(self, made: Path | None) -> Capture:
        """The photographs, selected and split; ``made`` is the folder that ``step`` filled."""
        options = self.options
        selection: dict[str, Any] = {"max_images": options.max_images, "split": options.split_rule}
        if options.kind == "courtyard":
            assert made is not None
            return read_colmap(self.name, made, exact_poses=True, **selection)
        path, selection["masks"] = str(options.path), options.masks
        if made is not None:
            model = made / SPARSE_FOLDERS[0]
            if options.kind == "transforms":
                capture = read_transforms(self.name, path, self._transforms, model, **selection)
            else:
                capture = read_posed(self.name, self._folder, self._posed, model, **selection)
        elif options.kind == "photos":
            capture = read_photos(self.name, path, images=options.images, **selection)
        else:
            capture = read_colmap(
                self.name, path, images=options.images, sparse=options.sparse, **selection
            )
        for name in capture.image_names:
            file = capture.images / name
            check_final_size(image_size(file), options.downscale, options.max_size, str(file))
        return capture

    @property
    def _folder(self) -> Path:
        return existing_folder(self.name, str(self.options.path))

    @cached_property
    def _posed(self) -> PosedImages:
        assert self._reader is not None
        return read_posed_images(self._reader, self._folder)

    @cached_property
    def _transforms(self) -> Transforms:
        folder = self._folder
        images = self.options.images
        if images is not None:
            require_subfolder(folder, images, "scene.images")
        return read_transforms_files(folder, self.options.transparent, images)


def _courtyard_step(options: SceneConfig) -> Step:
    inputs = {name: getattr(options, name) for name in ("views", "width", "height", "seed")}

    def build(folder: Path) -> None:
        with progress("scene") as report:
            render_courtyard(folder, progress=report, **inputs)

    return step_of(CAPTURE, inputs, build)


def _transforms_step(transforms: Transforms) -> Step:
    """The step that writes the cameras and points of ``transforms.json`` as a COLMAP model."""
    sizes = {
        name: [camera.width, camera.height] for name, (camera, *_) in transforms.images.items()
    }
    inputs = {"transforms": [file_sha256(file) for file in transforms.sources], "sizes": sizes}

    def build(target: Path) -> None:
        cloud = None
        if transforms.points is not None:
            points, colors = read_points(transforms.points)
            grey = np.full(points.shape, GREY, dtype=np.uint8)
            cloud = transforms.applied_to_points.undo(points), grey if colors is None else colors
        write_frames(target / SPARSE_FOLDERS[0], transforms.images, cloud=cloud)

    return step_of(CAPTURE, inputs, build)


def _reader_step(posed: PosedImages, reader: dict[str, Any]) -> Step:
    """The step that writes what a user's ``reader`` (class, code, options) read as a model."""
    cameras = {
        name: [asdict(camera), rotation.tolist(), translation.tolist()]
        for name, (camera, rotation, translation) in posed.images.items()
    }
    points = None if posed.points is None else [values.tolist() for values in posed.points]
    inputs = {"reader": reader, "cameras": sha256_of(cameras), "points": sha256_of(points)}

    def build(target: Path) -> None:
        write_frames(target / SPARSE_FOLDERS[0], posed.images, cloud=posed.points)

    return step_of(CAPTURE, inputs, build)


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

    def build(folder: Path) -> None:
        normalize_capture(capture, folder / MODEL_FOLDER)

    return step_of(CAPTURE, inputs, build)


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
        names = ("downscale", "max_size", "resample", "principal_point")
        self.preparation: dict[str, Any] = {name: getattr(options, name) for name in names}

    @property
    def inputs(self) -> dict[str, Any]:
        """The inputs on which the views depend, besides the cameras, which come from ``init``."""
        names = sha256_of(list(self.capture.test_names))
        return {"capture": self.capture.fingerprint, "test": names, **self.preparation}

    @cached_property
    def scene(self) -> Scene:
        """The undistorted, shrunk views, without training views that are copies of test views.

        ``init`` must be built. Prepared images are cached in the store.
        """
        with progress("scene") as report:
            scene = load_scene(
                self.capture,
                self.store.path(self.init) / MODEL_FOLDER,
                self.store.root / VIEWS,
                progress=report,
                made_by=view_versions(),
                **self.preparation,
            )
        return without_copies(scene)


@cache
def view_versions() -> dict[str, str | None]:
    """The versions of what makes the views' pixels: edited parts of gsbench, and packages.

    Pillow reads and shrinks images, pycolmap undistorts them.
    """
    return {
        **edited(states_of(CODE_OF_VIEWS)),
        **{package: version_of(package) for package in ("pycolmap", "pillow")},
    }


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
