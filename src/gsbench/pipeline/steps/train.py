"""Training: makes the model, its lineage, curves and events."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from gsbench.files import write_json
from gsbench.gaussians.initial import gaussians_from_cloud
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.ply import read_ply, write_ply
from gsbench.init import read_cloud
from gsbench.init.base import GAUSSIANS_FILE, MODEL_FOLDER
from gsbench.logs import progress
from gsbench.pipeline.steps.inputs import options_of, rasterizer_inputs, step_of
from gsbench.pipeline.steps.scene import Views
from gsbench.runs.keys import TRAIN, Step
from gsbench.runs.layout import LINEAGE, POINT_CLOUD, TRAINING
from gsbench.system.install import own_checkout
from gsbench.system.machine import describe_machine
from gsbench.system.resources import peak_memory_mb, reset_peak_memory
from gsbench.train.options import WITHOUT_EFFECT_ON_MODEL
from gsbench.train.trainer import Status, Trainer

if TYPE_CHECKING:
    from gsbench.pipeline.parts import Parts


def train_step(views: Views, parts: Parts) -> Step:
    """The step that trains on the training views, from the initialiser's cloud.

    It also keeps snapshots of the model at the earlier iterations of ``eval.at``, for `evaluate_step`.
    """
    densifier, rasterizer, options, seed = parts.densifier, parts.rasterizer, parts.train, parts.seed
    device, snapshot_at, user = parts.device, parts.measured_earlier, parts.user_code
    values = dataclasses.asdict(options)
    train_options = {key: value for key, value in values.items() if key not in WITHOUT_EFFECT_ON_MODEL}
    inputs: dict[str, Any] = {
        "scene": views.inputs,
        "init": views.init.key,
        "densify": options_of("densify", densifier, user),
        "raster": rasterizer_inputs(rasterizer, user),
        "train": train_options,
        "seed": seed,
    }
    if snapshot_at:
        inputs["snapshots"] = list(snapshot_at)

    def build(folder: Path) -> None:
        scene = views.scene
        initial = initial_gaussians(views.store.path(views.init), device)
        trainer = Trainer(scene, initial, densifier, rasterizer, options, seed, snapshot_at)
        reset_peak_memory(device)
        with progress("train") as report:

            def show(status: Status) -> None:
                speed = f"{status.iterations_per_second:.1f} it/s"
                note = f"loss {status.loss:.4f} | {status.num_gaussians:,} Gaussians | {speed}"
                report("iteration", status.step, options.iterations, note)

            gaussians = trainer.run(folder, show)
        write_ply(gaussians, folder / POINT_CLOUD)
        lineage: dict[str, Any] = {name: tensor.numpy() for name, tensor in densifier.lineage.state_dict().items()}
        np.savez_compressed(folder / LINEAGE, **lineage)
        summary = {
            "iterations": trainer.step,
            "num_init_points": len(initial),
            "num_gaussians": len(gaussians),
            "causes": densifier.lineage.causes_of_living(),
            "scene_extent": scene.extent,
            "seconds": trainer.seconds,
            "peak_memory_mb": peak_memory_mb(device),
            "machine": describe_machine(device),
            "checkout": own_checkout(),
        }
        write_json(folder / TRAINING, summary)

    return step_of(TRAIN, inputs, build, user)


def initial_gaussians(init: Path, device: torch.device) -> Gaussians:
    """The Gaussians that training starts from: the initialiser's own in the folder ``init``, or one per point."""
    if (init / GAUSSIANS_FILE).exists():
        return read_ply(init / GAUSSIANS_FILE, device)
    cloud = read_cloud(init / MODEL_FOLDER)
    return gaussians_from_cloud(cloud.points, cloud.colors, device)
