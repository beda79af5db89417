"""Training by gsbench: makes the model, its lineage, curves and events."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.densify import Densifier, Lineage
from gsbench.densify.volumetric import Volumetric
from gsbench.files import write_json
from gsbench.gaussians.initial import gaussians_from_cloud
from gsbench.gaussians.model import Gaussians, dc_to_bytes
from gsbench.gaussians.ply import read_ply, write_ply
from gsbench.init import read_cloud
from gsbench.init.base import GAUSSIANS_FILE, MODEL_FOLDER
from gsbench.logs import progress
from gsbench.pipeline.steps.scene import Views
from gsbench.runs.configuration import is_ingredient
from gsbench.runs.keys import TRAIN, Step, options_of, rasterizer_inputs, step_of
from gsbench.runs.layout import LINEAGE, POINT_CLOUD, TRAINING
from gsbench.runs.trial_record import InitialCloud, Oddity
from gsbench.scene.types import Capture
from gsbench.system.install import own_checkout
from gsbench.system.machine import describe_machine
from gsbench.system.resources import CLOCK, peak_memory_mb, reset_peak_memory
from gsbench.train.options import IDEAS
from gsbench.train.start import check_start
from gsbench.train.trainer import Status, Trainer

if TYPE_CHECKING:
    from gsbench.pipeline.parts import Parts

log = logging.getLogger(__name__)


def train_step(views: Views, parts: Parts) -> Step:
    """The step that trains on the training views, from the initialiser's cloud.

    It also keeps snapshots of the model at the earlier iterations of ``eval.at``, for
    `evaluate_step`.
    """
    densifier, rasterizer, options, seed = parts.trainer, parts.rasterizer, parts.train, parts.seed
    assert isinstance(densifier, Densifier)
    device, snapshot_at, user = parts.device, parts.measured_earlier, parts.user_code
    inputs: dict[str, Any] = {
        "scene": views.inputs,
        "init": views.init.key,
        "densify": options_of("densify", densifier, user),
        "raster": rasterizer_inputs(rasterizer, user),
        "train": _ingredients(parts),
        "seed": seed,
    }
    if snapshot_at:
        inputs["snapshots"] = snapshot_at

    def build(folder: Path) -> None:
        scene = views.scene
        initial = initial_gaussians(views.store.path(views.init), device)
        _log_normalization(views.capture, densifier)
        points, colors = initial.means.double().cpu().numpy(), dc_to_bytes(initial.sh_dc)
        start = check_points(points, colors, views, parts)
        trainer = Trainer(
            scene, initial, densifier, rasterizer, options, seed, snapshot_at, parts.ideas
        )
        reset_peak_memory(device)
        with progress("train") as report:

            def show(status: Status) -> None:
                speed = f"{status.iterations_per_second:.1f} it/s"
                note = f"loss {status.loss:.4f} | {status.num_gaussians:,} Gaussians | {speed}"
                report("iteration", status.step, options.iterations, note)

            gaussians = trainer.run(folder, show)
        write_ply(gaussians, folder / POINT_CLOUD)
        summary = {
            "iterations": trainer.step,
            "num_init_points": len(initial),
            "num_gaussians": len(gaussians),
            "seconds": trainer.seconds,
            "compile_seconds": CLOCK.report(),
            "peak_memory_mb": peak_memory_mb(device),
        }
        write_training(folder, summary, densifier.lineage, views, device, start)

    return step_of(TRAIN, inputs, build, user)


def _ingredients(parts: Parts) -> dict[str, Any]:
    """The settings ``train`` that may change the model, and the user's classes that they name."""
    ideas, user = parts.ideas, parts.user_code
    found = {
        name: value
        for name, value in dataclasses.asdict(parts.train).items()
        if is_ingredient(f"train.{name}") and name not in IDEAS
    }
    found |= {
        name: options_of("train", part, user, f"train.{name}")
        for name in ("loss", "schedule", "optimizer")
        if (part := getattr(ideas, name)) is not None
    }
    if ideas.terms:
        found["terms"] = [
            {"weight": one.weight} | options_of("train", one.term, user, f"train.terms.{number}")
            for number, one in enumerate(ideas.terms)
        ]
    return found


def check_points(
    points: NDArray[np.float64], colors: NDArray[np.uint8], views: Views, parts: Parts
) -> tuple[InitialCloud, tuple[Oddity, ...]]:
    """Check the points that training starts from against the training views (`check_start`)."""
    # A user's initialiser may lack the attribute.
    is_random = getattr(parts.initializer, "random_points", False)
    capture = views.capture
    return check_start(
        points, colors, views.scene, is_random, capture.normalization, capture.accept
    )


def _log_normalization(capture: Capture, densifier: Densifier) -> None:
    """Log the coordinates of the training and V_th in the scene's own units, if they differ."""
    normalization = capture.normalization
    if normalization.is_identity:
        return
    log.info(
        "scene %s: training has its cameras around the origin, at %.6g times the scale (the given "
        "centre is %s); results get the given coordinates",
        capture.name,
        normalization.scale,
        ", ".join(f"{value:.10g}" for value in normalization.center),
    )
    if isinstance(densifier, Volumetric) and densifier.threshold_mode == "absolute":
        own = densifier.volume_threshold / normalization.scale**3
        log.info(
            "densify.volume_threshold=%g is %.4g cubed units of the scene",
            densifier.volume_threshold,
            own,
        )


def write_training(
    folder: Path,
    summary: Mapping[str, Any],
    lineage: Lineage,
    views: Views,
    device: torch.device,
    start: tuple[InitialCloud, tuple[Oddity, ...]],
) -> None:
    """Write a trained model's lineage, and the ``summary`` of the training with more facts."""
    arrays: dict[str, Any] = lineage.state_dict()  # of tensors, which numpy converts
    np.savez_compressed(folder / LINEAGE, **arrays)
    facts = {
        "causes": lineage.causes_of_living(),
        "scene_extent": views.scene.extent / views.capture.normalization.scale,
        "initial_cloud": start[0].to_json(),
        "oddities": [odd.to_json() for odd in start[1]],
        "machine": describe_machine(device),
        "checkout": own_checkout(),
    }
    write_json(folder / TRAINING, {**summary, **facts})


def initial_gaussians(init: Path, device: torch.device) -> Gaussians:
    """The Gaussians that training starts from: the initialiser's own, or one for each point."""
    if (init / GAUSSIANS_FILE).exists():
        return read_ply(init / GAUSSIANS_FILE, device)
    cloud = read_cloud(init / MODEL_FOLDER)
    return gaussians_from_cloud(cloud.points, cloud.colors, device)
