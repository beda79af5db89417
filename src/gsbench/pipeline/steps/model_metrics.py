"""Metrics of a trained model rather than of pairs of images: its geometry, and its flicker along a path."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.errors import InputError
from gsbench.eval.facts import OF_MODELS
from gsbench.eval.flicker import camera_path, flicker
from gsbench.eval.geometry import (
    band_errors,
    completeness,
    depth_error,
    floater_share,
    in_front,
    point_depth_error,
    share_beyond,
)
from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians
from gsbench.init import read_cloud
from gsbench.init.base import MODEL_FOLDER
from gsbench.pipeline.steps.pictures import paint, surface_depth, unproject
from gsbench.pipeline.steps.scene import Views
from gsbench.raster import Rasterizer
from gsbench.scene.camera import Camera
from gsbench.scene.courtyard.render import courtyard_cameras, courtyard_depth, surface_distance
from gsbench.scene.images import read_image
from gsbench.scene.names import png_name
from gsbench.scene.options import SceneConfig
from gsbench.scene.types import Scene

if TYPE_CHECKING:
    import pycolmap

Array = NDArray[np.float64]
PERCENT = 100.0
TOLERANCE = 0.05  # m: what lies farther from the courtyard's surfaces is off them
SAME_POSE = 1e-3  # m, and as a difference of matrices: a pose that differs by more was estimated
MIN_POINTS = 10  # of a test view that no training view sees, below which a median says little
TIMED_RENDERS = 5  # of each view
FRAMES = 4  # after the first, of the path from a test view
STEP = 1 / 32  # of the way to the nearest other camera: about what a slow hand moves in a frame of a film


@dataclass
class ModelMetrics:
    """Values by view and key, and the reason for each of the keys that were asked for and cannot be had."""

    per_view: dict[str, dict[str, float]] = field(default_factory=dict)
    unavailable: dict[str, str] = field(default_factory=dict)

    def add(self, key: str, values: Mapping[str, float], reason: str) -> None:
        """Take one value for each view, or say for which ``reason`` there is none if one of them is no number."""
        if not values or not all(math.isfinite(value) for value in values.values()):
            self.unavailable[key] = reason
            return
        for view, value in values.items():
            self.per_view.setdefault(view, {})[key] = value


def nothing_known(asked: Iterable[str], reason: str) -> ModelMetrics:
    """Results that say of everything ``asked`` for (names of settings) that it is unavailable, for one reason."""
    settings = {f"eval.{name}" for name in asked}
    return ModelMetrics(unavailable={facts.key: reason for facts in OF_MODELS if facts.setting in settings})


def measure_model(
    asked: Mapping[str, Any],
    rasterizer: Rasterizer,
    gaussians: Gaussians,
    views: Views,
    background: Tensor,
    renders: Path,
) -> list[ModelMetrics]:
    """Everything that ``asked`` (`EvalConfig.of_model`) names; ``renders`` holds the pictures of the test views."""
    found = []
    if "geometry" in asked:
        found.append(measure_geometry(rasterizer, gaussians, views))
    if "flicker" in asked:
        found.append(measure_flicker(rasterizer, gaussians, views.scene, background))
    if "bands" in asked:
        found.append(measure_bands(views, renders))
    if "fps" in asked:
        found.append(measure_speed(rasterizer, gaussians, views.scene, background, asked["fps"]))
    return found


def measure_bands(views: Views, renders: Path) -> ModelMetrics:
    """Errors of the near, the middle and the far third of each test view, in 8-bit levels."""
    found = ModelMetrics()
    points = read_cloud(views.store.path(views.init) / MODEL_FOLDER).points
    errors = {}
    for view in views.scene.test:
        image, truth = read_image(renders / png_name(view.name)).astype(np.float64), view.image.astype(np.float64)
        counts = np.ones(image.shape[:2], dtype=np.bool_) if view.mask is None else view.mask
        errors[view.name] = band_errors(image, truth, view.camera, points, counts)
    for index, key in enumerate(("error_near", "error_middle", "error_far")):
        values = {name: thirds[index] for name, thirds in errors.items()}
        found.add(key, values, "a test view shows no point of the initial cloud")
    return found


def measure_speed(
    rasterizer: Rasterizer, gaussians: Gaussians, scene: Scene, background: Tensor, size: Sequence[int]
) -> ModelMetrics:
    """Renders a second of each test view at ``size`` (width, height) px: each rendered once, then timed."""
    found, speeds = ModelMetrics(), {}

    def now() -> float:
        if background.device.type == "cuda":  # renders are queued there
            torch.cuda.synchronize(background.device)
        return time.perf_counter()

    for view in scene.test:
        # The whole picture at another size, stretched if need be, so that the same Gaussians are in view.
        camera = view.camera.resized(*size)
        with torch.no_grad():
            rasterizer.render(gaussians, camera, MAX_SH_DEGREE, background)
            start = now()
            for _ in range(TIMED_RENDERS):
                rasterizer.render(gaussians, camera, MAX_SH_DEGREE, background)
            speeds[view.name] = TIMED_RENDERS / (now() - start)
    found.add("fps", speeds, "the clock did not move")
    return found


def measure_geometry(rasterizer: Rasterizer, gaussians: Gaussians, views: Views) -> ModelMetrics:
    """Depth error, points off surfaces and completeness where the scene's geometry is exact; floaters; and the depth
    at points of test views that training never used. All in percent."""
    found, scene = ModelMetrics(), views.scene
    depths = {view.name: surface_depth(rasterizer, gaussians, view.camera) for view in scene.test}
    truths = None
    try:
        truths = _exact_depths(scene, views.options)
        _against_truth(found, scene, depths, truths, views.options.seed)
    except InputError as error:
        found.unavailable |= dict.fromkeys(("depth_error", "off_surface", "completeness"), str(error))
    floating = {}
    centers = _array(gaussians.means)  # [N, 3]
    for view in scene.test:
        surface = depths[view.name] if truths is None else truths[view.name]
        floats = torch.from_numpy(in_front(centers, view.camera, surface)).to(gaussians.means)  # [N]
        features = torch.stack([floats, torch.zeros_like(floats), torch.zeros_like(floats)], -1)  # [N, 3]
        front, alpha = (_array(part) for part in paint(rasterizer, gaussians, features, view.camera))
        floating[view.name] = PERCENT * floater_share(front[..., 0], alpha, surface)
    found.add("floaters", floating, "a test view shows no surface")
    try:
        points = unused_points(views)
        errors = {
            view.name: PERCENT * point_depth_error(depths[view.name], view.camera, points[view.name])
            for view in scene.test
        }
        found.add("point_depth_error", errors, "a test view shows no surface at such points")
    except InputError as error:
        found.unavailable["point_depth_error"] = str(error)
    return found


def measure_flicker(rasterizer: Rasterizer, gaussians: Gaussians, scene: Scene, background: Tensor) -> ModelMetrics:
    """The flicker of a few frames from each test view towards the nearest other camera, in 8-bit levels."""
    found, values = ModelMetrics(), {}
    cameras = [view.camera for view in (*scene.train, *scene.test)]
    shares = STEP * np.arange(FRAMES + 1)
    for view in scene.test:
        others = [camera for camera in cameras if camera is not view.camera]
        nearest = min(others, key=lambda camera: float(np.linalg.norm(camera.center - view.camera.center)))
        path = camera_path(view.camera, nearest, shares)
        frames = []
        for camera in path:
            with torch.no_grad():
                image = rasterizer.render(gaussians, camera, MAX_SH_DEGREE, background).image.clamp(0, 1)
            frames.append((image, surface_depth(rasterizer, gaussians, camera)))
        steps = [
            flicker(image, unproject(depth, camera), following, torch.from_numpy(next_depth), next_camera)
            for (image, depth), camera, (following, next_depth), next_camera in zip(
                frames, path, frames[1:], path[1:], strict=False
            )
        ]
        values[view.name] = float(np.mean(steps))
    found.add("flicker", values, "neighbouring renders share no surface")
    return found


def unused_points(views: Views) -> dict[str, Array]:
    """The points [P, 3] of the capture's own COLMAP model that each test view sees and no training view does.

    Raises `InputError`, in one line, where there are too few or where test views helped to make the initial cloud.
    """
    from gsbench.scene.colmap import read_model, read_reference

    scene, capture = views.scene, views.capture
    train, test = {view.name for view in scene.train}, {view.name for view in scene.test}
    initial = read_model(views.store.path(views.init) / MODEL_FOLDER)
    if any(seen & test for _, seen in observations(initial)):
        raise InputError("test views helped to make the initial cloud, so training used their points")
    if capture.model is None:
        raise InputError("no COLMAP model came with the photographs")
    reference = read_reference(capture)
    centers = {image.name: image.projection_center() for image in reference.images.values() if image.has_pose}
    for view in scene.test:
        away = np.linalg.norm(centers[view.name] - view.camera.center) if view.name in centers else np.inf
        if away > SAME_POSE * scene.extent:
            raise InputError("the cameras are not those of the COLMAP model that came with the photographs")
    points = seen_by_test_alone(observations(reference), train, test)
    few = [name for name in test if len(points[name]) < MIN_POINTS]
    if few:
        raise InputError(
            f"{len(few)} of {len(test)} test views have fewer than {MIN_POINTS} points that no training view sees"
        )
    return points


def observations(model: pycolmap.Reconstruction) -> list[tuple[Array, set[str]]]:
    """The points of a COLMAP model, each [3] with the names of the images that see it, sorted by id."""
    names = {image_id: image.name for image_id, image in model.images.items()}
    return [
        (np.array(point.xyz), {names[element.image_id] for element in point.track.elements})
        for _, point in sorted(model.points3D.items())
    ]


def seen_by_test_alone(observed: Iterable[tuple[Array, set[str]]], train: set[str], test: set[str]) -> dict[str, Array]:
    """The points [P, 3] that each of the views ``test`` sees and none of ``train`` does."""
    by_view: dict[str, list[Array]] = {name: [] for name in test}
    for point, seen in observed:
        if not seen & train:
            for name in seen & test:
                by_view[name].append(point)
    return {name: np.array(points, dtype=np.float64).reshape(-1, 3) for name, points in by_view.items()}


def _exact_depths(scene: Scene, options: SceneConfig) -> dict[str, Array]:
    """The true depth of each test view, infinite in the sky; raises `InputError` saying why it is not known."""
    if options.kind != "courtyard":
        raise InputError("the true depth is known of the courtyard alone")
    cameras = courtyard_cameras(options.views, options.width, options.height)
    if not all(_same_pose(view.camera, cameras[view.name]) for view in scene.test):
        raise InputError("the cameras were estimated, in units of their own (init.poses=own)")
    return {view.name: courtyard_depth(view.camera, options.seed) for view in scene.test}


def _same_pose(camera: Camera, other: Camera) -> bool:
    return bool(
        np.abs(camera.center - other.center).max() < SAME_POSE
        and np.abs(camera.rotation - other.rotation).max() < SAME_POSE
    )


def _against_truth(
    found: ModelMetrics, scene: Scene, depths: dict[str, Array], truths: dict[str, Array], seed: int
) -> None:
    """Hold rendered surfaces against the courtyard's; pixels that should show sky do not count."""
    points, true_points = {}, {}
    for view in scene.test:
        depth, truth = depths[view.name], truths[view.name]
        solid = np.isfinite(truth)
        points[view.name] = unproject(depth, view.camera)[solid & np.isfinite(depth)]  # [P, 3]
        true_points[view.name] = unproject(np.where(solid, truth, 0.0), view.camera)[solid]
    everywhere = np.concatenate([*points.values()])  # a surface that one view misses, another may show
    names = [view.name for view in scene.test]
    values = {
        "depth_error": {name: depth_error(depths[name], truths[name]) for name in names},
        "off_surface": {name: share_beyond(surface_distance(points[name], seed), TOLERANCE) for name in names},
        "completeness": {name: completeness(true_points[name], everywhere, TOLERANCE) for name in names},
    }
    for key, shares in values.items():
        found.add(key, {name: PERCENT * share for name, share in shares.items()}, "a test view shows no surface")


def _array(tensor: Tensor) -> Array:
    return tensor.double().cpu().numpy()
