"""Rendering the test views at 8 bits, as PNG files store them, and measuring them."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image

from gsbench.eval.evaluator import Evaluator, measure_psnr, quantize, summarize
from gsbench.eval.facts import to_record
from gsbench.eval.images import as_unit_range
from gsbench.eval.protocol import Protocol
from gsbench.files import write_json
from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians
from gsbench.gaussians.ply import read_ply
from gsbench.logs import progress
from gsbench.pipeline.steps.regions import region_inputs, regions_of
from gsbench.pipeline.steps.scene import Views
from gsbench.runs.keys import EVALUATE, Step, options_of, rasterizer_inputs, step_of
from gsbench.runs.layout import METRICS, PER_VIEW, POINT_CLOUD, RENDERS
from gsbench.runs.trial_record import Earlier, Evaluation
from gsbench.scene.images import png_name
from gsbench.scene.types import COUNTED, Scene, nearest_training_cameras
from gsbench.system.resources import available_threads
from gsbench.train.trainer import snapshot_file

if TYPE_CHECKING:
    from gsbench.pipeline.parts import Parts

EXTRA = "eval.extra"  # the setting that names the user's own metrics


def evaluate_step(views: Views, trained: Step, parts: Parts) -> Step:
    """The step that renders and measures the model of ``trained`` and its earlier snapshots."""
    evaluator, user = parts.evaluator, parts.user_code
    inputs: dict[str, Any] = {
        "protocol": evaluator.protocol.id,
        # part of the key: weights that arrive later give a new result
        "unavailable": sorted(evaluator.unavailable),
        "train": trained.key,
    }
    own = {
        name: options_of("eval", metric, user, f"{EXTRA}.{name}")
        for name, metric in evaluator.extra.items()
    }
    regions = region_inputs(views, parts)
    further: dict[str, Any] = {
        "regions": regions,
        "extra": own,
        "more": list(evaluator.more),
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
    _write_metrics(folder, evaluator, per_view, scene, at)


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
