"""The four stages of a trial, each a function of its declared inputs, kept in the store."""

from __future__ import annotations

import csv
import dataclasses
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from PIL import Image
from scipy.spatial import cKDTree

from gsbench.config import EvalConfig, SceneConfig, TrainConfig, sha256_of
from gsbench.densify import Densifier
from gsbench.eval.protocol import Evaluator, get_protocol, quantize, summarize
from gsbench.files import write_json
from gsbench.gaussians.initial import gaussians_from_cloud
from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians
from gsbench.gaussians.ply import read_ply, write_ply
from gsbench.init import Sfm, read_cloud
from gsbench.init.base import GAUSSIANS_FILE, MODEL_FOLDER, Initializer
from gsbench.memory import peak_memory_mb, reset_peak_memory
from gsbench.pipeline.components import options_of
from gsbench.pipeline.figures import draw_ellipsoids
from gsbench.pipeline.maps import view_maps
from gsbench.pipeline.progress import Report, progress
from gsbench.pipeline.resources import available_threads
from gsbench.pipeline.stage_list import CAPTURE, EVALUATE, GROUND_TRUTH, INIT, TRAIN
from gsbench.pipeline.store import Entry, Store
from gsbench.pipeline.trainer import Status, Trainer
from gsbench.raster import Rasterizer
from gsbench.scene.courtyard import render_courtyard
from gsbench.scene.images import Resample, read_image
from gsbench.scene.load import PrincipalPoint, load_scene
from gsbench.scene.readers import read_colmap, read_photos
from gsbench.scene.types import Capture, Scene

PLY_FILE = "point_cloud.ply"
TRAINING_FILE = "training.json"
LINEAGE_FILE = "lineage.npz"
PER_VIEW_FILE = "per_view.csv"
METRICS_FILE = "metrics.json"
FIGURE_VOLUME = 0.03  # the paper's V_th, for baseline and idea alike


def read_capture(store: Store, options: SceneConfig) -> Capture:
    """The photographs of ``options``; the procedural courtyard is rendered into the store first."""
    selection: dict[str, Any] = {
        "max_images": options.max_images,
        "test_every": options.test_every,
        "train_list": options.train_list,
        "test_list": options.test_list,
    }
    if options.kind == "courtyard":
        inputs = {name: getattr(options, name) for name in ("views", "width", "height", "seed")}

        def build(folder: Path) -> None:
            with progress("scene") as report:
                render_courtyard(folder, progress=lambda done, total: report("courtyard", done, total), **inputs)

        entry = store.get(CAPTURE, inputs, build)
        return read_colmap(options.name, entry.path, exact_poses=True, **selection)
    path = Path(str(options.path)).expanduser()
    if options.kind == "photos":
        return read_photos(options.name, path, images=options.images, **selection)
    return read_colmap(options.name, path, images=options.images, sparse=options.sparse, **selection)


def initialize(store: Store, capture: Capture, initializer: Initializer) -> Entry:
    """Cameras and the first cloud: a COLMAP model and its report, shared by all trials with the same options."""
    reference = initialize(store, capture, Sfm()) if initializer.needs_reference(capture) else None
    inputs = {
        "capture": capture.fingerprint,
        "test": sha256_of(list(capture.test_names)),
        "exact_poses": capture.exact_poses,
        "options": options_of(initializer),
        "content": initializer.content() if hasattr(initializer, "content") else None,
        "reference": None if reference is None else reference.key,
        "pycolmap": version("pycolmap"),
    }

    def build(folder: Path) -> None:
        with progress("init") as report:
            check_readable(capture, report)
            cameras = None if reference is None else reference.path / MODEL_FOLDER
            initializer.run(capture, folder, report, reference=cameras)

    return store.get(INIT, inputs, build)


def check_readable(capture: Capture, report: Report) -> None:
    """Decode every photograph once, so that a damaged file is named before hours of work. Raises InputError."""
    with ThreadPoolExecutor(max_workers=available_threads()) as pool:
        for done, _ in enumerate(pool.map(lambda name: read_image(capture.images / name).shape, capture.image_names)):
            report("photographs", done + 1, len(capture.image_names))


def prepare_scene(store: Store, capture: Capture, init: Entry, options: SceneConfig) -> Scene:
    """The views at their final size, undistorted; prepared images are cached beside the store's stages."""
    with progress("scene") as report:
        return load_scene(
            capture,
            init.path / MODEL_FOLDER,
            store.root / "views",
            downscale=options.downscale,
            max_size=options.max_size,
            resample=cast(Resample, options.resample),
            principal_point=cast(PrincipalPoint, options.principal_point),
            progress=lambda done, total: report("views", done, total),
        )


def train(
    store: Store,
    scene: Scene,
    scene_inputs: dict[str, Any],
    init: Entry,
    densifier: Densifier,
    rasterizer: Rasterizer,
    options: TrainConfig,
    seed: int,
    device: torch.device,
) -> Entry:
    """Train, and keep the model, its lineage, metrics and events."""
    ignored = ("name", "log_every", "checkpoint_every", "checkpoint_minutes", "volume_histogram")
    inputs = {
        "scene": scene_inputs,
        "init": init.key,
        "densify": options_of(densifier),
        "raster": rasterizer.name,
        "train": {key: value for key, value in dataclasses.asdict(options).items() if key not in ignored},
        "seed": seed,
    }

    def build(folder: Path) -> None:
        initial = initial_gaussians(init, device)
        trainer = Trainer(scene, initial, densifier, rasterizer, options, seed)
        reset_peak_memory(device)
        with progress("train") as report:

            def show(status: Status) -> None:
                speed = f"{status.iterations_per_second:.1f} it/s"
                note = f"loss {status.loss:.4f} | {status.num_gaussians:,} Gaussians | {speed}"
                report("iteration", status.step, options.iterations, note)

            gaussians = trainer.run(folder, show)
        write_ply(gaussians, folder / PLY_FILE)
        lineage: dict[str, Any] = {name: tensor.numpy() for name, tensor in densifier.lineage.state_dict().items()}
        np.savez_compressed(folder / LINEAGE_FILE, **lineage)
        summary = {
            "iterations": trainer.step,
            "num_init_points": len(initial),
            "num_gaussians": len(gaussians),
            "causes": densifier.lineage.causes_of_living(),
            "scene_extent": scene.extent,
            "seconds": trainer.seconds,
            "peak_memory_mb": peak_memory_mb(device),
        }
        write_json(folder / TRAINING_FILE, summary)

    return store.get(TRAIN, inputs, build)


def initial_gaussians(init: Entry, device: torch.device) -> Gaussians:
    """What the training starts from: the Gaussians that the initialiser left, or one for each of its points."""
    if (init.path / GAUSSIANS_FILE).exists():
        return read_ply(init.path / GAUSSIANS_FILE, device)
    cloud = read_cloud(init.path / MODEL_FOLDER)
    return gaussians_from_cloud(cloud.points, cloud.colors, device)


def keep_ground_truth(store: Store, scene: Scene, scene_inputs: dict[str, Any], init: Entry) -> Entry:
    """The test photographs as they are compared with, once for all trials that share them."""

    def build(folder: Path) -> None:
        for view in scene.test:
            Image.fromarray(view.image).save(folder / png_name(view.name))

    return store.get(GROUND_TRUTH, {"scene": scene_inputs, "init": init.key}, build)


def evaluate(
    store: Store,
    scene: Scene,
    init: Entry,
    trained: Entry,
    rasterizer: Rasterizer,
    train_options: TrainConfig,
    options: EvalConfig,
    device: torch.device,
) -> Entry:
    """Render the test views, 8 bits, and measure them by the protocol; the metrics read what the PNGs hold."""
    weights = None if options.weights is None else Path(options.weights).expanduser()
    evaluator = Evaluator(
        get_protocol(options.protocol), device, tuple(options.lpips), options.flip, weights, options.download
    )
    inputs = {
        "train": trained.key,
        "protocol": evaluator.protocol.id,
        "unavailable": sorted(evaluator.unavailable),  # so that weights that arrive later are used
        "maps": options.maps,
    }

    def build(folder: Path) -> None:
        gaussians = read_ply(trained.path / PLY_FILE, device)
        background = torch.tensor(list(train_options.background), device=device)
        (folder / "renders").mkdir(exist_ok=True)
        per_view: dict[str, dict[str, float]] = {}
        with progress("evaluate") as report:
            for done, view in enumerate(scene.test, 1):
                with torch.no_grad():
                    rendered = rasterizer.render(gaussians, view.camera, MAX_SH_DEGREE, background).image
                image = quantize(rendered).cpu().numpy()  # [H, W, 3] uint8
                Image.fromarray(image).save(folder / "renders" / png_name(view.name))
                per_view[view.name] = evaluator.evaluate_view(image, view.image)
                report("views", done, len(scene.test))
        if options.maps:
            write_maps(folder / "maps", scene, init, gaussians, rasterizer)
            draw_figures(folder / "figures", folder / "renders", scene, trained, gaussians)
        write_per_view(folder / PER_VIEW_FILE, per_view)
        metrics = {"metrics": summarize(per_view, evaluator.unavailable), "unavailable": evaluator.unavailable}
        write_json(folder / METRICS_FILE, metrics)

    return store.get(EVALUATE, inputs, build)


def write_maps(folder: Path, scene: Scene, init: Entry, gaussians: Gaussians, rasterizer: Rasterizer) -> None:
    """One ``<view>.npz`` for each test view (see ``view_maps``)."""
    folder.mkdir(exist_ok=True)
    points = cKDTree(read_cloud(init.path / MODEL_FOLDER).points)
    for view in scene.test:
        maps: dict[str, Any] = view_maps(rasterizer, gaussians, view.camera, points)
        np.savez_compressed(folder / Path(png_name(view.name)).with_suffix(".npz"), **maps)


def draw_figures(folder: Path, renders: Path, scene: Scene, trained: Entry, gaussians: Gaussians) -> None:
    """The voluminous Gaussians of the model, drawn over its first test view."""
    folder.mkdir(exist_ok=True)
    with np.load(trained.path / LINEAGE_FILE) as lineage:
        causes = torch.from_numpy(lineage["causes"][lineage["ids"]])  # [N]
    for view in scene.test[:1]:
        render = np.asarray(Image.open(renders / png_name(view.name)))
        picture = draw_ellipsoids(render, gaussians, causes, view.camera, FIGURE_VOLUME)
        picture.save(folder / "ellipsoids.png")


def png_name(view_name: str) -> str:
    """File name for the picture of a view; sub-folders become part of the name."""
    return Path(view_name).with_suffix(".png").as_posix().replace("/", "__")


def write_per_view(path: Path, per_view: dict[str, dict[str, float]]) -> None:
    """One row a view, in order; a metric that a view lacks is left empty."""
    names = sorted({name for row in per_view.values() for name in row})
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, ["view", *names])
        writer.writeheader()
        for view, row in per_view.items():
            writer.writerow({"view": view} | {name: repr(value) for name, value in row.items()})


def scene_inputs(capture: Capture, options: SceneConfig) -> dict[str, Any]:
    """What the prepared views depend on besides the cameras."""
    return {
        "capture": capture.fingerprint,
        "test": sha256_of(list(capture.test_names)),
        "downscale": options.downscale,
        "max_size": options.max_size,
        "resample": options.resample,
        "principal_point": options.principal_point,
    }


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    found = {"python": sys.version.split()[0]}
    for package in ("gsbench", "torch", "numpy", "numba", "pycolmap", "kornia", "gsplat"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
