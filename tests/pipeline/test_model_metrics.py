"""Metrics of models made by hand: on the courtyard's surfaces, off them, and before them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from gsbench.errors import InputError
from gsbench.eval.facts import FLICKER, GEOMETRY, OF_MODELS
from gsbench.gaussians.model import Gaussians, rgb_to_dc
from gsbench.init.base import MODEL_FOLDER
from gsbench.pipeline.steps.model_metrics import (
    ModelMetrics,
    measure_flicker,
    measure_geometry,
    measure_speed,
    nothing_known,
    seen_by_test_alone,
    unused_points,
)
from gsbench.pipeline.steps.pictures import unproject
from gsbench.raster.reference import ReferenceRasterizer
from gsbench.scene.camera import Camera
from gsbench.scene.courtyard.render import courtyard_cameras, courtyard_depth
from gsbench.scene.options import SceneConfig
from gsbench.scene.types import Scene, View

SIZE = (48, 36)
OPTIONS = SceneConfig(name="courtyard", kind="courtyard", views=48, width=SIZE[0], height=SIZE[1])
RASTERIZER = ReferenceRasterizer()


def a_scene() -> Scene:
    """Three neighbouring cameras of the courtyard, zoomed onto the well; the middle one is the test view."""
    blank = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    cameras = list(courtyard_cameras(48, *SIZE).items())[10:13]
    views = [View(name, replace(camera, fx=6 * camera.fx, fy=6 * camera.fy), blank) for name, camera in cameras]
    return Scene("courtyard", (views[0], views[2]), (views[1],))


def discs_on_surfaces(scene: Scene, push: float = 0.0) -> Gaussians:
    """An opaque ball for each pixel of the test view that shows a surface, ``push`` times its depth too far away."""
    view = scene.test[0]
    depth = courtyard_depth(view.camera)
    solid = np.isfinite(depth)
    points = unproject(np.where(solid, depth, 1.0) * (1 + push), view.camera)[solid]  # [N, 3]
    radius = 0.5 * depth[solid] / view.camera.fx
    return balls(points, radius)


def balls(points: np.ndarray, radius: np.ndarray, color: float = 0.5) -> Gaussians:
    n = len(points)
    return Gaussians(
        means=torch.from_numpy(points).float(),
        log_scales=torch.from_numpy(np.log(radius)).float()[:, None].repeat(1, 3),
        quaternions=torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        opacity_logits=torch.full((n,), 4.0),
        sh_dc=rgb_to_dc(torch.full((n, 3), color)),
        sh_rest=torch.zeros(n, 15, 3),
    )


def views_of(scene: Scene, options: SceneConfig, folder: Path, capture: object = None) -> SimpleNamespace:
    """The parts of `Views` that are asked for; the initial model is an empty one unless ``folder`` has one."""
    model = folder / "init" / MODEL_FOLDER
    if not model.exists():
        model.mkdir(parents=True)
        pycolmap.Reconstruction().write(model)
    store = SimpleNamespace(path=lambda step: folder / "init")
    return SimpleNamespace(
        scene=scene, options=options, store=store, init=None, capture=capture or SimpleNamespace(model=None)
    )


def geometry(gaussians: Gaussians, scene: Scene, folder: Path, options: SceneConfig = OPTIONS) -> ModelMetrics:
    return measure_geometry(RASTERIZER, gaussians, views_of(scene, options, folder))  # type: ignore[arg-type]


def test_a_model_on_the_surfaces_is_nearly_perfect_and_one_behind_them_is_not(tmp_path: Path) -> None:
    scene = a_scene()
    (good,) = geometry(discs_on_surfaces(scene), scene, tmp_path).per_view.values()
    (bad,) = geometry(discs_on_surfaces(scene, push=0.1), scene, tmp_path).per_view.values()
    assert good["depth_error"] < 2.5 < bad["depth_error"] == pytest.approx(10, abs=1)
    assert good["off_surface"] < 20 < 70 < bad["off_surface"]  # pixels at edges see a mean of two depths
    assert bad["completeness"] < 40 < 75 < good["completeness"]
    assert good["floaters"] == bad["floaters"] == 0


def test_a_ball_before_the_camera_floats(tmp_path: Path) -> None:
    scene = a_scene()
    camera = scene.test[0].camera
    center = camera.center + 1.0 * camera.rotation[2]  # 1 m ahead; the well stands 4.5 m away
    floater = balls(center[None], np.array([0.015]))
    floater.opacity_logits[:] = -1.0  # translucent: an opaque one would be the first surface of a render
    model = Gaussians.concatenate([discs_on_surfaces(scene), floater])
    (values,) = geometry(model, scene, tmp_path).per_view.values()
    opacity = 1 / (1 + math.e)
    covered = opacity * 2 * math.pi * (0.015 * camera.fx) ** 2 / (SIZE[0] * SIZE[1])  # the integral of a Gaussian
    assert values["floaters"] == pytest.approx(100 * covered, rel=0.1)
    options = SceneConfig(name="mine", kind="photos", path="somewhere")  # no truth: the render's own depth counts
    (own,) = geometry(model, scene, tmp_path, options).per_view.values()
    assert own["floaters"] == pytest.approx(values["floaters"], rel=0.05)
    assert own.keys() == {"floaters"}


def test_what_cannot_be_known_has_a_reason(tmp_path: Path) -> None:
    scene = a_scene()
    model = discs_on_surfaces(scene)
    own = geometry(model, scene, tmp_path, SceneConfig(name="mine", kind="photos", path="somewhere"))
    assert "courtyard alone" in own.unavailable["depth_error"]
    assert own.unavailable["point_depth_error"] == "no COLMAP model came with the photographs"
    moved = Scene(scene.name, scene.train, (View(scene.test[0].name, scene.train[0].camera, scene.test[0].image),))
    found = geometry(model, moved, tmp_path)
    assert "init.poses=own" in found.unavailable["completeness"]
    empty = model.select(torch.arange(1))
    empty.opacity_logits -= 20
    nothing = geometry(empty, scene, tmp_path)
    assert nothing.unavailable["off_surface"] == "a test view shows no surface"
    assert not nothing.per_view.get(scene.test[0].name, {}).keys() & {"depth_error", "floaters"}


def test_every_metric_of_a_model_is_measured_or_has_a_reason(tmp_path: Path) -> None:
    scene = a_scene()
    model = discs_on_surfaces(scene)
    found = geometry(model, scene, tmp_path)
    seen = {key for row in found.per_view.values() for key in row} | found.unavailable.keys()
    assert seen == {facts.key for facts in OF_MODELS if facts.setting == GEOMETRY}
    assert nothing_known(["geometry"], "why").unavailable.keys() == seen
    assert nothing_known(["flicker"], "why").unavailable == {
        facts.key: "why" for facts in OF_MODELS if facts.setting == FLICKER
    }
    for facts in OF_MODELS:
        for row in found.per_view.values():
            assert facts.lowest <= row.get(facts.key, 0.0) <= (facts.highest or math.inf)


def test_a_smooth_model_flickers_less_than_one_of_specks() -> None:
    scene = a_scene()
    smooth = discs_on_surfaces(scene)
    specks = discs_on_surfaces(scene)
    specks.sh_dc = rgb_to_dc(torch.rand(len(specks), 1, generator=torch.Generator().manual_seed(0)).repeat(1, 3))
    values = [
        measure_flicker(RASTERIZER, model, scene, torch.zeros(3)).per_view[scene.test[0].name]["flicker"]
        for model in (smooth, specks)
    ]
    assert 0 <= values[0] < values[1] < 128


STRAIGHT = Camera(1024, 768, 1280.0, 1280.0, 512.0, 384.0, np.eye(3), np.zeros(3))


def pose_of(image: pycolmap.Image) -> dict[str, np.ndarray]:
    matrix = image.cam_from_world().matrix()
    return {"rotation": matrix[:, :3], "translation": matrix[:, 3]}


def test_points_that_test_views_alone_see() -> None:
    observed = [(np.full(3, float(k)), set(seen)) for k, seen in enumerate(["ab", "at", "t", "tu", "", "bu"])]
    found = seen_by_test_alone(observed, {"a", "b"}, {"t", "u", "v"})
    assert {name: points[:, 0].tolist() for name, points in found.items()} == {"t": [2.0, 3.0], "u": [3.0], "v": []}


def test_points_come_from_the_model_of_the_capture_and_only_if_training_had_none_of_them(tmp_path: Path) -> None:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 6, 80
    model = pycolmap.synthesize_dataset(options)
    images = {image.name: image for image in model.images.values()}
    names = sorted(images)
    train, test = names[:4], names[4:]
    for point_id in sorted(model.points3D)[:30]:  # of these no training view is left
        track = [(element.image_id, element.point2D_idx) for element in model.points3D[point_id].track.elements]
        for image_id, index in track:
            if model.images[image_id].name in train:
                model.delete_observation(image_id, index)
    folder = tmp_path / "images"
    for name in names:
        camera = model.cameras[images[name].camera_id]
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (camera.width, camera.height)).save(folder / name)
    sparse = tmp_path / "sparse"
    sparse.mkdir()
    model.write(sparse)
    cameras = {name: replace(STRAIGHT, **pose_of(images[name])) for name in names}
    blank = np.zeros((1, 1, 3), np.uint8)
    scene = Scene(
        "made",
        tuple(View(name, cameras[name], blank) for name in train),
        tuple(View(name, cameras[name], blank) for name in test),
    )
    capture = SimpleNamespace(name="made", images=folder, image_names=tuple(names), model=sparse)
    found = unused_points(views_of(scene, OPTIONS, tmp_path / "free", capture))  # type: ignore[arg-type]
    assert {name: len(points) for name, points in found.items()} == dict.fromkeys(test, 30)
    seeded = views_of(scene, OPTIONS, tmp_path / "seeded", capture)
    model.write(seeded.store.path(None) / MODEL_FOLDER)
    with pytest.raises(InputError, match="helped to make the initial cloud"):
        unused_points(seeded)  # type: ignore[arg-type]


def test_speed_is_measured_at_the_size_that_is_asked_for() -> None:
    scene, sizes = a_scene(), []

    class Watched(ReferenceRasterizer):
        def render(self, gaussians: Gaussians, camera: Camera, *rest: Any) -> Any:
            sizes.append((camera.width, camera.height))
            return super().render(gaussians, camera, *rest)

    found = measure_speed(Watched(), discs_on_surfaces(scene).select(torch.arange(20)), scene, torch.zeros(3), [64, 20])
    assert set(sizes) == {(64, 20)}
    assert found.per_view[scene.test[0].name]["fps"] > 0
