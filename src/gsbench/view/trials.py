"""Trials as the viewer shows them: read from folders and store, drawn from any camera."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from gsbench.analysis.addresses import TRIAL, fitting
from gsbench.analysis.cells import with_variants
from gsbench.analysis.results import TrialResult, load_experiment
from gsbench.errors import InputError
from gsbench.eval.evaluator import quantize
from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians
from gsbench.gaussians.ply import read_ply
from gsbench.init.base import MODEL_FOLDER
from gsbench.raster.base import Rasterizer
from gsbench.runs.keys import INIT
from gsbench.runs.layout import GROUND_TRUTH, POINT_CLOUD, RESULTS, STORE
from gsbench.runs.store import Store
from gsbench.scene.colmap import pinhole_camera, read_model
from gsbench.scene.images import png_name, read_image
from gsbench.scene.types import PINHOLE_NAMES, Camera, View
from gsbench.words import listed, split_outside_brackets

TEXT_COLOR, SHADOW = (255, 255, 255), (0, 0, 0)
TEXT_SIZE = 1 / 36  # of a picture's height; smaller if a label does not fit its pane
MARGIN = 0.5  # of the text's size
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class ViewedTrial:
    """A trained model, and the test views with the evaluation's cameras and photographs."""

    label: str
    gaussians: Gaussians
    views: tuple[View, ...]
    background: tuple[float, ...]
    rasterizer: Rasterizer

    def draw(self, camera: Camera) -> Picture:
        """The model from ``camera`` as the evaluation renders it, [H, W, 3] uint8."""
        background = torch.tensor(self.background, device=self.gaussians.means.device)
        with torch.no_grad():
            output = self.rasterizer.render(self.gaussians, camera, MAX_SH_DEGREE, background)
        return quantize(output.image).cpu().numpy()


def find_trial(address: str, runs: Path) -> TrialResult:
    """The trial at ``address`` (`TRIAL`); if several seeds match, the first.

    Raises InputError if there is no such trial, or if several arms match.
    """
    folder = Path(address).expanduser()
    if folder.is_dir():
        return _trial_in(folder.resolve())
    parts = split_outside_brackets(address, ":")
    if len(parts) not in (3, 4) or not all(parts):
        raise InputError(f"{address!r} is neither a folder nor EXPERIMENT:SCENE:ARM[:SEED]")
    name, scene, arm, *seed = parts
    trials = with_variants(load_experiment(runs, name).trials)
    wanted = [t for t in trials if t.scene == scene and str(t.seed) in (seed or [str(t.seed)])]
    matches = [trial for own in fitting(wanted, [arm]).values() for trial in own]
    lowest = min((trial.seed for trial in matches), default=0)
    first = [trial for trial in matches if trial.seed == lowest]
    if len(first) != 1:
        there = {f"{name}:{one.scene}:{one.arm}:{one.seed}" for one in first or trials}
        raise InputError(
            f"{address} names {len(first)} complete trials; choose one of {listed(sorted(there))}"
        )
    return first[0]


def _trial_in(folder: Path) -> TrialResult:
    # RUNS/EXPERIMENT/SCENE/ARM/TRIAL
    if len(folder.parents) < 4 or not (folder / RESULTS).is_file():
        raise InputError(f"{folder} is not a trial's folder; give {TRIAL}")
    experiment = load_experiment(folder.parents[3], folder.parents[2].name)
    for trial in (*experiment.trials, *experiment.older):
        if trial.path == folder:
            return trial
    raise InputError(f"{folder} is not a complete trial; give {TRIAL}")


def model_file(trial: TrialResult) -> Path:
    """The PLY file of a trial's Gaussians; raises InputError if it has none or it was changed."""
    if trial.from_renders:
        raise InputError(f"{trial.label} was evaluated from renders: it has no model")
    if change := trial.folder.change(thorough=True):
        raise InputError(f"{trial.label}: {change}: run this trial again")
    return trial.path / POINT_CLOUD


def load_viewed(trial: TrialResult, rasterizer: Rasterizer, device: torch.device) -> ViewedTrial:
    """Read all that the viewer draws; raises InputError naming a missing or damaged file."""
    return ViewedTrial(
        label=f"{trial.scene} {trial.init}-{trial.densify} seed {trial.seed}",
        # A page's numbers are float32, so the viewer works in the coordinates of the training.
        gaussians=read_ply(model_file(trial), device, trial.record.to_training),
        views=read_test_views(trial, model_folder(trial)),
        background=background_of(trial),
        rasterizer=rasterizer,
    )


def background_of(trial: TrialResult) -> tuple[float, ...]:
    """The training's background, three numbers; raises InputError for anything else."""
    color = trial.config.get("train.background", (0.0, 0.0, 0.0))
    if len(color) != 3 or any(type(channel) not in (int, float) for channel in color):
        raise InputError(f"{trial.path}: train.background in its configuration is not a colour")
    return tuple(map(float, color))


def model_folder(trial: TrialResult) -> Path:
    """The COLMAP model that a trial started from; raises InputError if it is gone or changed."""
    store = Store(trial.path.parents[3] / STORE)
    return store.existing(INIT, trial.record.hashes.get(INIT.name, "")) / MODEL_FOLDER


def read_test_views(trial: TrialResult, model_dir: Path) -> tuple[View, ...]:
    """The test views in the order of names, as the evaluation saw them."""
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
        if intrinsics.model_name not in PINHOLE_NAMES:
            intrinsics = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), intrinsics)
        camera = pinhole_camera(intrinsics, image.cam_from_world()).resized(width, height)
        if centred:
            camera = replace(camera, cx=width / 2, cy=height / 2)
        views.append(View(image.name, camera, picture))
    if not views:
        raise InputError(
            f"{trial.path / 'ground_truth'} holds no picture of a test view: run this trial again"
        )
    return tuple(views)


def photograph_at(camera: Camera, view: View) -> Picture:
    """The photograph of ``view`` resampled for the intrinsics of ``camera``, black outside."""
    own, photograph = view.camera, Image.fromarray(view.image)
    shrink = max(own.fx / camera.fx, own.fy / camera.fy)
    # shrink with a filter first, because the transform below only interpolates neighbouring pixels
    if shrink > 1:
        own = own.resized(max(1, round(own.width / shrink)), max(1, round(own.height / shrink)))
        photograph = photograph.resize((own.width, own.height), Image.Resampling.BOX)
    sx, sy = own.fx / camera.fx, own.fy / camera.fy  # photograph pixels for one of the picture
    coefficients = (sx, 0, own.cx - sx * camera.cx, 0, sy, own.cy - sy * camera.cy)
    size = (camera.width, camera.height)
    return np.asarray(
        photograph.transform(size, Image.Transform.AFFINE, coefficients, Image.Resampling.BILINEAR)
    )


def side_by_side(panes: Sequence[tuple[str, Picture]]) -> Picture:
    """Labelled pictures of the same height, from left to right."""
    image = Image.fromarray(np.hstack([picture for _, picture in panes]))
    draw, left = ImageDraw.Draw(image), 0
    for label, picture in panes:
        height, width = picture.shape[:2]
        size = TEXT_SIZE * height
        length = ImageFont.load_default(size).getlength(label)
        size *= min(1.0, (width - 2 * MARGIN * size) / length)
        if left:
            draw.line([(left, 0), (left, height)], fill=TEXT_COLOR)
        draw.text(
            (left + MARGIN * size, MARGIN * size),
            label,
            TEXT_COLOR,
            ImageFont.load_default(size),
            stroke_width=max(1, round(size / 8)),
            stroke_fill=SHADOW,
        )
        left += width
    return np.asarray(image)
