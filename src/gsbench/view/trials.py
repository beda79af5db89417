"""Reading trials for the viewer, from their folders and from the initial models in the store."""

import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.analysis.results import TrialResult, load_experiment
from gsbench.densify.volumetric import log_volume
from gsbench.errors import InputError
from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.ply import read_ply
from gsbench.init.base import MODEL_FOLDER, PointCloud
from gsbench.runs.keys import INIT
from gsbench.runs.layout import GROUND_TRUTH, LINEAGE, POINT_CLOUD, RESULTS, STORE
from gsbench.runs.store import Store
from gsbench.scene.colmap import PINHOLE_MODELS, model_points, pinhole_camera, read_model
from gsbench.scene.images import png_name, read_image
from gsbench.scene.types import Camera, View
from gsbench.view import ADDRESS


@dataclass(frozen=True)
class ViewedTrial:
    """A trained model with everything that the viewer draws.

    ``causes`` [N] are the values of ``Cause`` of the Gaussians, and ``log10_volumes`` [N] their volumes (world
    units^3). ``cloud`` is the initial cloud. ``views`` are the test views with the evaluation's cameras and
    photographs.
    """

    label: str
    gaussians: Gaussians
    causes: NDArray[np.uint8]
    log10_volumes: NDArray[np.float64]
    cloud: PointCloud
    views: tuple[View, ...]
    background: tuple[float, float, float]


def find_trial(address: str, runs: Path) -> TrialResult:
    """The trial at ``address`` (see ``ADDRESS``); if several seeds match, the first.

    Raises InputError if there is no such trial, or if several arms match.
    """
    folder = Path(address).expanduser()
    if folder.is_dir():
        return _trial_in(folder.resolve())
    parts = address.split(":")
    if len(parts) not in (3, 4) or not all(parts):
        raise InputError(f"{address!r} is neither a folder nor EXPERIMENT:SCENE:DENSIFY[:SEED]")
    name, scene, densify, *seed = parts
    experiment = load_experiment(runs, name)
    matches = [
        trial
        for trial in experiment.trials
        if trial.scene == scene
        and densify in (trial.densify, f"{trial.init}-{trial.densify}")
        and (not seed or str(trial.seed) == seed[0])
    ]
    if not matches:
        addresses = sorted({f"{name}:{t.scene}:{t.init}-{t.densify}:{t.seed}" for t in experiment.trials})
        raise InputError(f"no complete trial {address}; there are {', '.join(addresses)}")
    first = [trial for trial in matches if trial.seed == matches[0].seed]
    if len(first) > 1:
        raise InputError(f"{address} names {len(first)} trials; give a folder: {', '.join(str(t.path) for t in first)}")
    return matches[0]


def _trial_in(folder: Path) -> TrialResult:
    if len(folder.parents) < 4 or not (folder / RESULTS).is_file():
        raise InputError(f"{folder} is not a trial's folder; give {ADDRESS}")
    experiment = load_experiment(folder.parents[3], folder.parents[2].name)
    for trial in experiment.trials:
        if trial.path == folder:
            return trial
    raise InputError(f"{folder} is not a complete trial; give {ADDRESS}")


def model_file(trial: TrialResult) -> Path:
    """The PLY file of a trial's Gaussians; raises InputError for a trial without a model."""
    if trial.from_renders:
        raise InputError(f"{trial.label} was evaluated from renders: it has no model")
    return trial.path / POINT_CLOUD


def load_viewed(trial: TrialResult, device: torch.device) -> ViewedTrial:
    """Read everything that the viewer draws of ``trial``; raises InputError naming a missing or damaged file."""
    gaussians = read_ply(model_file(trial), device)
    model_dir = _model_folder(trial)
    background = trial.config.get("train.background", (0.0, 0.0, 0.0))
    return ViewedTrial(
        label=f"{trial.scene} {trial.init}-{trial.densify} seed {trial.seed}",
        gaussians=gaussians,
        causes=read_causes(trial.path / LINEAGE, len(gaussians)),
        log10_volumes=(log_volume(gaussians.log_scales).double() / np.log(10)).cpu().numpy(),
        cloud=PointCloud(*model_points(read_model(model_dir))),
        views=read_test_views(trial, model_dir),
        background=tuple(background),
    )


def read_causes(path: Path, num_gaussians: int) -> NDArray[np.uint8]:
    """The cause of each remaining Gaussian, [N], from ``lineage.npz``."""
    try:
        with np.load(path) as lineage:
            causes = lineage["causes"][lineage["ids"]]
    except (OSError, ValueError, KeyError, IndexError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path} cannot be read ({error}): run this trial again") from error
    if len(causes) != num_gaussians:
        raise InputError(f"{path} is of {len(causes)} Gaussians, the model has {num_gaussians}: run this trial again")
    return causes


def _model_folder(trial: TrialResult) -> Path:
    runs = trial.path.parents[3]
    folder = Store(runs / STORE).folder(INIT, trial.record.hashes.get("init", "")) / MODEL_FOLDER
    if not folder.is_dir():
        raise InputError(f"{folder} is gone, and it had the cameras of {trial.label}: run this trial again")
    return folder


def read_test_views(trial: TrialResult, model_dir: Path) -> tuple[View, ...]:
    """The test views in the order of their names, with the photographs and cameras of the evaluation."""
    import pycolmap

    model = read_model(model_dir)
    centred = trial.config.get("scene.principal_point") == "centred"
    views = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        path = trial.path / GROUND_TRUTH / png_name(image.name)
        if not (image.has_pose and path.is_file()):
            continue
        picture = read_image(path)  # [H, W, 3]
        height, width = picture.shape[:2]
        intrinsics = model.cameras[image.camera_id]
        if intrinsics.model not in PINHOLE_MODELS:
            intrinsics = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), intrinsics)
        camera: Camera = pinhole_camera(intrinsics, image.cam_from_world()).resized(width, height)
        if centred:
            camera = replace(camera, cx=width / 2, cy=height / 2)
        views.append(View(image.name, camera, picture))
    if not views:
        raise InputError(f"{trial.path / 'ground_truth'} holds no picture of a test view: run this trial again")
    return tuple(views)
