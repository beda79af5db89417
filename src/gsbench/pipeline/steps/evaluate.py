"""Evaluation: the test views rendered at 8 bits and measured by the protocol; the metrics read what the PNGs hold."""

from __future__ import annotations

import csv
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image
from scipy.spatial import cKDTree

from gsbench.eval.evaluator import Evaluator, quantize, summarize
from gsbench.eval.facts import to_record
from gsbench.files import write_json
from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians
from gsbench.gaussians.paper_values import VOLUME_THRESHOLD
from gsbench.gaussians.ply import read_ply
from gsbench.init import read_cloud
from gsbench.init.base import MODEL_FOLDER
from gsbench.logs import progress
from gsbench.pipeline.steps.inputs import UserCode, options_of, rasterizer_inputs, step_of
from gsbench.pipeline.steps.model_metrics import ModelMetrics, measure_model, nothing_known
from gsbench.pipeline.steps.pictures import draw_ellipsoids, view_maps
from gsbench.pipeline.steps.scene import Views
from gsbench.raster import Rasterizer
from gsbench.runs.layout import ELLIPSOIDS, FIGURES, LINEAGE, MAPS, METRICS, PER_VIEW, POINT_CLOUD, RENDERS
from gsbench.runs.stages import EVALUATE, Step
from gsbench.runs.trial_record import Earlier, Evaluation
from gsbench.scene.images import read_image
from gsbench.scene.names import png_name
from gsbench.scene.nearness import COUNTED, nearness
from gsbench.scene.types import Scene
from gsbench.train.trainer import snapshot_file

if TYPE_CHECKING:
    from gsbench.pipeline.parts import Parts

EXTRA = "eval.extra"  # where a configuration has the user's own metrics


def evaluate_step(views: Views, trained: Step, parts: Parts) -> Step:
    """Render and measure the model of ``trained``, and its snapshots of earlier iterations; or renders as they are.

    ``eval.maps`` also keeps maps of the views and pictures large Gaussians; ``of_model`` says what is measured of the
    model itself (`gsbench.eval.options.EvalConfig.of_model`). The key of a training by another program knows nothing of
    the rendering, so it is in this step's.
    """
    if parts.program is not None and not parts.program.leaves_model:
        return _measure_step(views, trained, parts)
    rasterizer, evaluator, device = parts.rasterizer, parts.evaluator, parts.device
    background, maps, of_model = parts.train.background, parts.eval.maps, parts.eval.of_model
    earlier, user = parts.measured_earlier, parts.user_code
    inputs: dict[str, Any] = {
        "train": trained.key,
        "protocol": evaluator.protocol.id,
        "unavailable": sorted(evaluator.unavailable),  # so that weights that arrive later are used
        "maps": maps,
    }
    if earlier:
        inputs["earlier"] = list(earlier)
    if parts.program is not None:
        inputs |= {"raster": rasterizer_inputs(rasterizer, user), "background": list(background)}
    inputs |= _further_metrics(evaluator, user) | dict(of_model)

    def build(folder: Path) -> None:
        training, scene = views.store.path(trained), views.scene
        gaussians = read_ply(training / POINT_CLOUD, device)
        color = torch.tensor(list(background), device=device)  # [3]
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
            for step in earlier:
                if (snapshot := training / snapshot_file(step)).exists():  # else a limit of time came first
                    model = read_ply(snapshot, device)
                    means = summarize(measure(model, f"iteration {step}", None), evaluator.unavailable)
                    at[str(step)] = Earlier(metrics=means, num_gaussians=len(model))
        if maps:
            write_maps(folder / MAPS, scene, views.store.path(views.init), gaussians, rasterizer)
            draw_figures(folder / FIGURES, folder / RENDERS, scene, training, gaussians)
        found = measure_model(of_model, rasterizer, gaussians, views, color, folder / RENDERS)
        _write_metrics(folder, evaluator, per_view, found, scene, at)

    return step_of(EVALUATE, inputs, build, user)


def _measure_step(views: Views, trained: Step, parts: Parts) -> Step:
    """Measure the renders that another program left in ``trained``, as they are."""
    evaluator, of_model, user = parts.evaluator, parts.eval.of_model, parts.user_code
    inputs: dict[str, Any] = {
        "renders": trained.key,
        "protocol": evaluator.protocol.id,
        "unavailable": sorted(evaluator.unavailable),
    }
    inputs |= _further_metrics(evaluator, user) | dict(of_model)

    def build(folder: Path) -> None:
        training, scene = views.store.path(trained), views.scene
        shutil.copytree(training / RENDERS, folder / RENDERS)
        per_view = {}
        with progress("evaluate") as report:
            for done, view in enumerate(scene.test, 1):
                per_view[view.name] = evaluator.evaluate_view(
                    read_image(folder / RENDERS / png_name(view.name)), view.image, view.mask
                )
                report("views", done, len(scene.test))
        unknown = nothing_known(of_model, "another program's renders are known, not its model")
        _write_metrics(folder, evaluator, per_view, [unknown], scene)

    return step_of(EVALUATE, inputs, build, user)


def _further_metrics(evaluator: Evaluator, user: UserCode) -> dict[str, Any]:
    """The user's own metrics and those of ``eval.more`` as they enter a key; nothing where there are none."""
    own = {name: options_of("eval", metric, user, f"{EXTRA}.{name}") for name, metric in evaluator.extra.items()}
    further: dict[str, Any] = {"extra": own, "more": list(evaluator.more)}
    return {name: value for name, value in further.items() if value}


def _write_metrics(
    folder: Path,
    evaluator: Evaluator,
    per_view: Mapping[str, Mapping[str, float]],
    of_model: Sequence[ModelMetrics],
    scene: Scene,
    at: Mapping[str, Earlier] = MappingProxyType({}),
) -> None:
    """Write the metrics of images and of the model, by view and as means; views with their nearest training views."""
    rows = {view: dict(row) for view, row in per_view.items()}
    for found in of_model:
        for view, row in found.per_view.items():
            rows[view] |= row
    cameras, training = ([view.camera for view in views] for views in (scene.test, scene.train))
    near = nearness(cameras, training, scene.extent)
    places = {view.name: place for view, place in zip(scene.test, near, strict=True)}  # no metrics: they are in no mean
    if any(view.mask is not None for view in [*scene.train, *scene.test]):
        places = {view.name: places[view.name] | {COUNTED: view.counted} for view in scene.test}
    write_per_view(folder / PER_VIEW, {view: row | places.get(view, {}) for view, row in rows.items()})
    summary = replace(summary_of(evaluator, rows), at=dict(at))
    for found in of_model:
        summary = replace(summary, unavailable=summary.unavailable | found.unavailable)
    write_json(folder / METRICS, summary.to_json())


def summary_of(evaluator: Evaluator, per_view: Mapping[str, Mapping[str, float]]) -> Evaluation:
    """Summary of an evaluation: the means, what is missing and why, and the facts of a user's metrics."""
    return Evaluation(
        metrics=summarize(per_view, evaluator.unavailable),
        unavailable=dict(evaluator.unavailable),
        awaited=sorted(evaluator.awaited),
        facts={name: to_record(facts) for name, facts in evaluator.own.items()},
    )


def write_maps(folder: Path, scene: Scene, init: Path, gaussians: Gaussians, rasterizer: Rasterizer) -> None:
    """Write one ``<view>.npz`` for each test view (see ``view_maps``)."""
    folder.mkdir(exist_ok=True)
    points = cKDTree(read_cloud(init / MODEL_FOLDER).points)
    for view in scene.test:
        maps: dict[str, Any] = view_maps(rasterizer, gaussians, view.camera, points)
        np.savez_compressed(folder / Path(png_name(view.name)).with_suffix(".npz"), **maps)


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
