"""Evaluation: the test views rendered at 8 bits and measured by the protocol; the metrics read what the PNGs hold."""

from __future__ import annotations

import csv
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image

from gsbench.eval.evaluator import Evaluator, quantize, summarize
from gsbench.eval.facts import to_record
from gsbench.files import write_json
from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians
from gsbench.gaussians.paper_values import VOLUME_THRESHOLD
from gsbench.gaussians.ply import read_ply
from gsbench.logs import progress
from gsbench.pipeline.steps.inputs import UserCode, options_of, rasterizer_inputs, step_of
from gsbench.pipeline.steps.pictures import draw_ellipsoids
from gsbench.pipeline.steps.scene import Views
from gsbench.raster import Rasterizer
from gsbench.runs.keys import EVALUATE, Step
from gsbench.runs.layout import ELLIPSOIDS, FIGURES, LINEAGE, METRICS, PER_VIEW, POINT_CLOUD, RENDERS
from gsbench.runs.trial_record import Earlier, Evaluation
from gsbench.scene.camera import COUNTED, nearest_training_cameras
from gsbench.scene.images import read_image
from gsbench.scene.names import png_name
from gsbench.scene.types import Scene
from gsbench.train.trainer import snapshot_file

if TYPE_CHECKING:
    from gsbench.pipeline.parts import Parts

EXTRA = "eval.extra"  # where a configuration has the user's own metrics
TIMED_RENDERS = 5  # of each view, for its speed


def evaluate_step(views: Views, trained: Step, parts: Parts) -> Step:
    """Render and measure the model of ``trained``, and its snapshots of earlier iterations; or renders as they are.

    ``eval.maps`` also pictures large Gaussians; ``eval.fps`` is the size at which the speed of rendering is measured.
    """
    evaluator, size, user = parts.evaluator, parts.eval.fps, parts.user_code
    inputs: dict[str, Any] = {
        "protocol": evaluator.protocol.id,
        "unavailable": sorted(evaluator.unavailable),  # so that weights that arrive later are used
        **_further_metrics(evaluator, user, size),
    }
    if parts.program is not None and not parts.program.leaves_model:
        return step_of(EVALUATE, {"renders": trained.key} | inputs, _measuring(views, trained, parts), user)
    inputs |= {"train": trained.key, "maps": parts.eval.maps}
    if parts.measured_earlier:
        inputs["earlier"] = parts.measured_earlier
    if parts.program is not None:  # the key of a training by another program knows nothing of the rendering
        background = list(parts.train.background)
        inputs |= {"raster": rasterizer_inputs(parts.rasterizer, user), "background": background}
    return step_of(EVALUATE, inputs, _rendering(views, trained, parts), user)


def _rendering(views: Views, trained: Step, parts: Parts) -> Callable[[Path], None]:
    """A build that renders the model of ``trained`` and measures that."""
    rasterizer, evaluator, device = parts.rasterizer, parts.evaluator, parts.device

    def build(folder: Path) -> None:
        training, scene = views.store.path(trained), views.scene
        gaussians = read_ply(training / POINT_CLOUD, device)
        color = torch.tensor(list(parts.train.background), device=device)  # [3]
        (folder / RENDERS).mkdir(exist_ok=True)

        def measure(model: Gaussians, phase: str, renders: Path | None) -> dict[str, dict[str, float]]:
            per_view = {}
            for done, view in enumerate(scene.test, 1):
                with torch.no_grad():
                    rendered = rasterizer.render(model, view.camera, MAX_SH_DEGREE, color).image
                image = quantize(rendered).cpu().numpy()  # [H, W, 3] uint8
                if renders is not None:
                    Image.fromarray(image).save(renders / png_name(view.name))
                per_view[view.name] = evaluator.evaluate_view(image, view.image, view.mask)
                report(phase, done, len(scene.test))
            return per_view

        at: dict[str, Earlier] = {}
        with progress("evaluate") as report:
            per_view = measure(gaussians, "views", folder / RENDERS)
            for step in parts.measured_earlier:
                if (snapshot := training / snapshot_file(step)).exists():  # else a limit of time came first
                    model = read_ply(snapshot, device)
                    means = summarize(measure(model, f"iteration {step}", None), evaluator.unavailable)
                    at[str(step)] = Earlier(metrics=means, num_gaussians=len(model))
        if parts.eval.maps:
            draw_figures(folder / FIGURES, folder / RENDERS, scene, training, gaussians)
        if parts.eval.fps is not None:
            for view, speed in measure_speed(rasterizer, gaussians, scene, color, parts.eval.fps).items():
                per_view[view]["fps"] = speed
        _write_metrics(folder, evaluator, per_view, scene, at=at)

    return build


def _measuring(views: Views, trained: Step, parts: Parts) -> Callable[[Path], None]:
    """A build that measures the renders that another program left in ``trained``, as they are."""
    evaluator = parts.evaluator

    def build(folder: Path) -> None:
        scene, per_view = views.scene, {}
        shutil.copytree(views.store.path(trained) / RENDERS, folder / RENDERS)
        with progress("evaluate") as report:
            for done, view in enumerate(scene.test, 1):
                image = read_image(folder / RENDERS / png_name(view.name))
                per_view[view.name] = evaluator.evaluate_view(image, view.image, view.mask)
                report("views", done, len(scene.test))
        unknown = {} if parts.eval.fps is None else {"fps": "another program's renders are known, not its model"}
        _write_metrics(folder, evaluator, per_view, scene, unknown)

    return build


def _further_metrics(evaluator: Evaluator, user: UserCode, size: Sequence[int] | None) -> dict[str, Any]:
    """The user's own metrics, ``eval.more`` and ``eval.fps`` as they enter a key; nothing where there are none."""
    own = {name: options_of("eval", metric, user, f"{EXTRA}.{name}") for name, metric in evaluator.extra.items()}
    further: dict[str, Any] = {"extra": own, "more": list(evaluator.more), "fps": size}
    return {name: value for name, value in further.items() if value}


def measure_speed(
    rasterizer: Rasterizer, gaussians: Gaussians, scene: Scene, background: torch.Tensor, size: Sequence[int]
) -> dict[str, float]:
    """Renders a second of each test view at ``size`` (width, height) px: each rendered once, then timed."""
    speeds = {}

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
    return speeds


def _write_metrics(
    folder: Path,
    evaluator: Evaluator,
    per_view: Mapping[str, Mapping[str, float]],
    scene: Scene,
    unavailable: Mapping[str, str] = MappingProxyType({}),
    at: Mapping[str, Earlier] = MappingProxyType({}),
) -> None:
    """Write the metrics by view and as means; views with their nearest training views."""
    cameras, training = ([view.camera for view in views] for views in (scene.test, scene.train))
    near = nearest_training_cameras(cameras, training, scene.extent)
    places = {view.name: place for view, place in zip(scene.test, near, strict=True)}  # no metrics: they are in no mean
    if any(view.mask is not None for view in [*scene.train, *scene.test]):
        places = {view.name: places[view.name] | {COUNTED: view.counted} for view in scene.test}
    write_per_view(folder / PER_VIEW, {view: dict(row) | places.get(view, {}) for view, row in per_view.items()})
    summary = summary_of(evaluator, per_view)
    summary = replace(summary, at=dict(at), unavailable=summary.unavailable | dict(unavailable))
    write_json(folder / METRICS, summary.to_json())


def summary_of(evaluator: Evaluator, per_view: Mapping[str, Mapping[str, float]]) -> Evaluation:
    """Summary of an evaluation: the means, what is missing and why, and the facts of a user's metrics."""
    return Evaluation(
        metrics=summarize(per_view, evaluator.unavailable),
        unavailable=dict(evaluator.unavailable),
        awaited=sorted(evaluator.awaited),
        facts={name: to_record(facts) for name, facts in evaluator.own.items()},
    )


def draw_figures(folder: Path, renders: Path, scene: Scene, training: Path, gaussians: Gaussians) -> None:
    """The voluminous Gaussians of the model, drawn over its first test view."""
    folder.mkdir(exist_ok=True)
    with np.load(training / LINEAGE) as lineage:
        causes = torch.from_numpy(lineage["causes"][lineage["ids"]])  # [N]
    for view in scene.test[:1]:
        render = np.asarray(Image.open(renders / png_name(view.name)))
        picture = draw_ellipsoids(render, gaussians, causes, view.camera, VOLUME_THRESHOLD)
        picture.save(folder / ELLIPSOIDS)


def write_per_view(path: Path, per_view: Mapping[str, Mapping[str, float]]) -> None:
    """Write one row for each view, in order; a metric that a view lacks is left empty."""
    names = sorted({name for row in per_view.values() for name in row})
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, ["view", *names])
        writer.writeheader()
        for view, row in per_view.items():
            writer.writerow({"view": view} | {name: repr(value) for name, value in row.items()})
