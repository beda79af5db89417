"""Rendering the test views at 8 bits, as PNG files store them, and measuring them."""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from gsbench.densify.lineage import read_causes
from gsbench.densify.volumetric import log_volume
from gsbench.eval.evaluator import Evaluator, measure_psnr, quantize, summarize
from gsbench.eval.facts import to_record
from gsbench.eval.images import as_unit_range
from gsbench.eval.protocol import Protocol
from gsbench.events import Cause
from gsbench.files import write_json
from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians
from gsbench.gaussians.paper_values import VOLUME_THRESHOLD
from gsbench.gaussians.ply import read_ply
from gsbench.logs import progress
from gsbench.pipeline.steps.regions import region_inputs, regions_of
from gsbench.pipeline.steps.scene import Views
from gsbench.raster import Rasterizer
from gsbench.raster.reference import project
from gsbench.runs.keys import EVALUATE, Step, options_of, rasterizer_inputs, step_of
from gsbench.runs.layout import (
    ELLIPSOIDS,
    FIGURES,
    LINEAGE,
    METRICS,
    PER_VIEW,
    POINT_CLOUD,
    RENDERS,
)
from gsbench.runs.trial_record import Earlier, Evaluation
from gsbench.scene.images import png_name, read_image
from gsbench.scene.types import COUNTED, Camera, Scene, nearest_training_cameras
from gsbench.system.resources import available_threads
from gsbench.train.trainer import snapshot_file

if TYPE_CHECKING:
    from gsbench.pipeline.parts import Parts

EXTRA = "eval.extra"  # the setting that names the user's own metrics
TIMED_RENDERS = 5  # of each view, to measure the speed


def evaluate_step(views: Views, trained: Step, parts: Parts) -> Step:
    """The step that renders and measures the model of ``trained`` and its earlier snapshots.

    ``eval.maps`` adds a picture of the large Gaussians; ``eval.fps`` is the image size at which the
    speed of rendering is measured.
    """
    evaluator, user = parts.evaluator, parts.user_code
    inputs: dict[str, Any] = {
        "protocol": evaluator.protocol.id,
        # part of the key: weights that arrive later give a new result
        "unavailable": sorted(evaluator.unavailable),
        "train": trained.key,
        "maps": parts.eval.maps,
    }
    own = {
        name: options_of("eval", metric, user, f"{EXTRA}.{name}")
        for name, metric in evaluator.extra.items()
    }
    regions = region_inputs(views, parts)
    further = {
        "regions": regions,
        "extra": own,
        "more": list(evaluator.more),
        "fps": parts.eval.fps,
        "earlier": parts.measured_earlier,
    }
    # the key of `trained` covers the rendering only if gsbench trained
    if parts.program is not None:
        inputs["raster"] = rasterizer_inputs(parts.rasterizer, user)
        inputs["background"] = list(parts.train.background)
    # Metrics that are off are left out, so that a new one changes no key of others.
    inputs |= {name: value for name, value in further.items() if value}
    return step_of(EVALUATE, inputs, partial(_measure, views, trained, parts), user)


def _measure(views: Views, trained: Step, parts: Parts, folder: Path) -> None:
    """Render the model of ``trained`` and its earlier snapshots, and measure the renders."""
    rasterizer, evaluator, device = parts.rasterizer, parts.evaluator, parts.device
    training, scene = views.store.path(trained), views.scene
    gaussians = read_ply(training / POINT_CLOUD, device)
    color = torch.tensor(list(parts.train.background), device=device)  # [3]
    (folder / RENDERS).mkdir(exist_ok=True)

    regions = regions_of(views, parts)

    def measure(model: Gaussians, phase: str, renders: Path | None) -> dict[str, dict[str, float]]:
        per_view, written = {}, []
        # Compressing a picture takes a core ten times as long as its metrics take a GPU.
        with ThreadPoolExecutor(available_threads()) as beside:
            for done, view in enumerate(scene.test, 1):
                with torch.no_grad():
                    rendered = rasterizer.render(model, view.camera, MAX_SH_DEGREE, color).image
                image = quantize(rendered).cpu().numpy()  # [H, W, 3] uint8
                if renders is not None:
                    path = renders / png_name(view.name)
                    written.append(beside.submit(Image.fromarray(image).save, path))
                per_view[view.name] = evaluator.evaluate_view(
                    image, view.image, view.mask, regions.get(view.name, {})
                )
                report(phase, done, len(scene.test))
        for saved in written:
            saved.result()  # raises what the thread raised
        return per_view

    at: dict[str, Earlier] = {}
    with progress("evaluate") as report:
        per_view = measure(gaussians, "views", folder / RENDERS)
        for step in parts.measured_earlier:
            snapshot = training / snapshot_file(step)
            if not snapshot.exists():  # train.max_seconds ended the training before
                continue
            model = read_ply(snapshot, device)
            means = summarize(measure(model, f"iteration {step}", None), evaluator.unavailable)
            at[str(step)] = Earlier(metrics=means, num_gaussians=len(model))
    if parts.eval.maps:
        causes = torch.from_numpy(read_causes(training / LINEAGE, len(gaussians)))
        first = scene.test[0]
        render = read_image(folder / RENDERS / png_name(first.name))
        picture = draw_ellipsoids(render, gaussians, causes, first.camera, VOLUME_THRESHOLD)
        (folder / FIGURES).mkdir(exist_ok=True)
        picture.save(folder / FIGURES / ELLIPSOIDS)
    if parts.eval.fps is not None:
        speeds = measure_speed(rasterizer, gaussians, scene, color, parts.eval.fps)
        for view, speed in speeds.items():
            per_view[view]["fps"] = speed
    _write_metrics(folder, evaluator, per_view, scene, at)


def measure_speed(
    rasterizer: Rasterizer,
    gaussians: Gaussians,
    scene: Scene,
    background: torch.Tensor,
    size: Sequence[int],
) -> dict[str, float]:
    """The renders per second of each test view at ``size`` (width, height) px.

    The first render of a view is not timed.
    """
    speeds = {}

    def now() -> float:
        if background.device.type == "cuda":  # kernels run asynchronously there
            torch.cuda.synchronize(background.device)
        return time.perf_counter()

    for view in scene.test:
        # The whole picture is scaled, and stretched if `size` has another shape: the same Gaussians
        # stay in view.
        camera = view.camera.resized(*size)
        with torch.no_grad():
            rasterizer.render(gaussians, camera, MAX_SH_DEGREE, background)
            start = now()
            for _ in range(TIMED_RENDERS):
                rasterizer.render(gaussians, camera, MAX_SH_DEGREE, background)
            speeds[view.name] = TIMED_RENDERS / (now() - start)
    return speeds


def _write_metrics(
    folder: Path,
    evaluator: Evaluator,
    per_view: Mapping[str, Mapping[str, float]],
    scene: Scene,
    at: dict[str, Earlier],
) -> None:
    """Write the metrics of each view and their means.

    The row of a view also has its nearness to the training views and, with masks, the share of its
    pixels that count.
    """
    cameras, training = ([view.camera for view in views] for views in (scene.test, scene.train))
    near = nearest_training_cameras(cameras, training, scene.extent)
    masked = any(view.mask is not None for view in [*scene.train, *scene.test])
    # These columns are no metrics, so they are not in `per_view`, from which means are taken.
    rows = {name: dict(row) for name, row in per_view.items()}
    for view, distances in zip(scene.test, near, strict=True):
        counted = {COUNTED: view.counted} if masked else {}
        rows[view.name] |= distances | counted
    write_per_view(folder / PER_VIEW, rows)
    plain = one_color_psnr(scene, evaluator.protocol)
    summary = replace(summary_of(evaluator, per_view), at=at, one_color_psnr=plain)
    write_json(folder / METRICS, summary.to_json())


def one_color_psnr(scene: Scene, protocol: Protocol) -> float | None:
    """The mean PSNR in dB of the training views' mean colour, which a trained model must beat.

    None without test views.
    """
    if not scene.test:
        return None
    sums, count = np.zeros(3, np.int64), 0
    for view in scene.train:
        counted = np.ones(view.image.shape[:2], np.bool_) if view.mask is None else view.mask
        # Rows first: numpy adds up the long axis several times faster than three channels.
        sums += (view.image * counted[..., None]).sum(axis=0, dtype=np.int64).sum(axis=0)
        count += int(counted.sum())
    color = as_unit_range(torch.from_numpy(np.rint(sums / count).astype(np.uint8)), torch.float32)
    # An `Evaluator` would also measure SSIM, which takes ten times as long.
    psnr, values = measure_psnr(protocol), []
    for view in scene.test:
        truth = as_unit_range(torch.from_numpy(view.image), torch.float32)
        plain = color.expand_as(truth)
        mask = None if view.mask is None else torch.from_numpy(view.mask)
        values.append(psnr(plain, truth, mask))
    return float(np.mean(values))


def summary_of(evaluator: Evaluator, per_view: Mapping[str, Mapping[str, float]]) -> Evaluation:
    """The means, the missing metrics with reasons, and the facts about the user's metrics."""
    return Evaluation(
        metrics=summarize(per_view, evaluator.unavailable),
        unavailable=dict(evaluator.unavailable),
        awaited=sorted(evaluator.awaited),
        facts={name: to_record(facts) for name, facts in evaluator.own.items()},
    )


def write_per_view(path: Path, per_view: Mapping[str, Mapping[str, float]]) -> None:
    """Write one row for each view, in order; a metric that a view lacks is left empty."""
    names = sorted(set().union(*per_view.values()))
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, ["view", *names])
        writer.writeheader()
        for view, row in per_view.items():
            writer.writerow({"view": view} | {name: repr(value) for name, value in row.items()})


# ---- a picture of the large Gaussians

OUTLINE_POINTS = 48
MAX_OUTLINES = 1500  # of the most voluminous Gaussians; more outlines would hide the picture
MIN_OPACITY = 0.05  # fainter Gaussians are not seen
FONT_SIZE, LINE_HEIGHT = 11, 14  # px, of the legend
TEXT_COLOR = (255, 255, 255)


def draw_ellipsoids(
    render: NDArray[np.uint8],
    gaussians: Gaussians,
    causes: torch.Tensor,
    camera: Camera,
    volume_threshold: float,
) -> Image.Image:
    """The view ``render`` [H, W, 3] with outlines of Gaussians above ``volume_threshold``.

    The threshold is in cubed scene units. An outline is the projected ellipsoid of one standard
    deviation. Its colour tells which rule made the Gaussian (``causes`` [N], see ``Cause``). At
    most the 1500 most voluminous Gaussians are drawn. A legend is below the view.
    """
    volumes = log_volume(gaussians.log_scales)  # [N]
    large = (volumes > math.log(volume_threshold)) & (gaussians.opacities > MIN_OPACITY)
    index = large.nonzero().flatten()
    index = index[torch.argsort(volumes[index], descending=True)][:MAX_OUTLINES]
    projected = project(
        gaussians.select(index).map(lambda tensor: tensor.detach().double().cpu()), camera
    )
    image = Image.fromarray(render).convert("RGB")
    canvas = ImageDraw.Draw(image)
    angles = np.linspace(0, math.tau, OUTLINE_POINTS)
    circle = np.stack([np.cos(angles), np.sin(angles)])  # [2, K]
    for mean, conic, member in zip(projected.means, projected.conics, projected.index, strict=True):
        a, b, c = conic.tolist()
        covariance = np.linalg.inv(np.array([[a, b], [b, c]]))  # px^2
        outline = np.linalg.cholesky(covariance) @ circle + mean.numpy()[:, None]  # [2, K]
        color = Cause(int(causes[index[member]])).color
        canvas.line([tuple(point) for point in outline.T.round().astype(int).tolist()], fill=color)
    drawn = [cause for cause in Cause if (causes[index[projected.index]] == int(cause)).any()]
    condition = f"volume above {volume_threshold:g}"
    title = f"{condition}, made by:" if drawn else f"none has a {condition}"
    return _with_legend(image, title, drawn)


def _with_legend(image: Image.Image, title: str, causes: Sequence[Cause]) -> Image.Image:
    """The image with a legend below: a line for the title, and one in its colour for each cause."""
    lines = [(title, TEXT_COLOR), *((cause.words, cause.color) for cause in causes)]
    result = Image.new("RGB", (image.width, image.height + len(lines) * LINE_HEIGHT))
    result.paste(image, (0, 0))
    canvas, font = ImageDraw.Draw(result), ImageFont.load_default(FONT_SIZE)
    for row, (text, color) in enumerate(lines):
        canvas.text((2, image.height + row * LINE_HEIGHT), text, fill=color, font=font)
    return result
