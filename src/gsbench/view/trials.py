"""Trials as the viewer shows them: read from folders and store, drawn from any camera.

A picture is the render, the initial cloud, or large Gaussians coloured by their causes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from gsbench.analysis.addresses import TRIAL, fitting
from gsbench.analysis.cells import with_variants
from gsbench.analysis.results import TrialResult, load_experiment
from gsbench.densify.lineage import read_causes
from gsbench.densify.volumetric import log_volume
from gsbench.errors import InputError
from gsbench.eval.evaluator import quantize
from gsbench.events import Cause
from gsbench.gaussians.initial import gaussians_from_cloud
from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians, rgb_to_dc
from gsbench.gaussians.paper_values import VOLUME_THRESHOLD
from gsbench.gaussians.ply import read_ply
from gsbench.init.base import MODEL_FOLDER, PointCloud
from gsbench.raster.base import Rasterizer, RenderOutput
from gsbench.runs.keys import INIT
from gsbench.runs.layout import GROUND_TRUTH, LINEAGE, POINT_CLOUD, RESULTS, STORE
from gsbench.runs.store import Store
from gsbench.scene.colmap import model_points, pinhole_camera, read_model
from gsbench.scene.images import png_name, read_image
from gsbench.scene.types import PINHOLE_NAMES, Camera, View
from gsbench.words import split_outside_brackets

DIMMED = 0.35  # brightness of the render behind Gaussians coloured by their causes
TEXT_COLOR, SHADOW = (255, 255, 255), (0, 0, 0)
TEXT_SIZE = 1 / 36  # of a picture's height; smaller if a word does not fit its pane
MARGIN = 0.5  # of the text's size
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class ViewedTrial:
    """A trained model with everything that the viewer draws.

    ``causes`` [N] are the values of ``Cause`` of the Gaussians, and ``log10_volumes`` [N] their
    volumes (world units^3). ``cloud`` is the initial cloud. ``views`` are the test views with the
    evaluation's cameras and photographs.
    """

    label: str
    gaussians: Gaussians
    causes: NDArray[np.uint8]
    log10_volumes: NDArray[np.float64]
    cloud: PointCloud
    views: tuple[View, ...]
    background: tuple[float, float, float]


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
    matches.sort(key=lambda trial: trial.seed)
    if not matches:
        arms = {f"{name}:{trial.scene}:{trial.arm}:{trial.seed}" for trial in trials}
        raise InputError(f"no complete trial {address}; there are {', '.join(sorted(arms))}")
    first = [trial for trial in matches if trial.seed == matches[0].seed]
    if len(first) > 1:
        arms = {f"{name}:{scene}:{trial.arm}" for trial in first}
        raise InputError(
            f"{address} names {len(first)} trials; choose one of {', '.join(sorted(arms))}"
        )
    return matches[0]


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


def load_viewed(trial: TrialResult, device: torch.device) -> ViewedTrial:
    """Read all that the viewer draws; raises InputError naming a missing or damaged file."""
    # A page's numbers are float32, so the viewer works in the coordinates of the training.
    gaussians = read_ply(model_file(trial), device, trial.record.to_training)
    model_dir = model_folder(trial)
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
        camera: Camera = pinhole_camera(intrinsics, image.cam_from_world()).resized(width, height)
        if centred:
            camera = replace(camera, cx=width / 2, cy=height / 2)
        views.append(View(image.name, camera, picture))
    if not views:
        raise InputError(
            f"{trial.path / 'ground_truth'} holds no picture of a test view: run this trial again"
        )
    return tuple(views)


@dataclass(frozen=True)
class Layers:
    """Settings of a picture."""

    sh_degree: int = MAX_SH_DEGREE
    share: float = 100.0  # % of the Gaussians, the most opaque
    causes: bool = False  # show the Gaussians above a volume in the colours of their causes
    log10_volume: float = math.log10(VOLUME_THRESHOLD)  # that volume
    cloud: bool = False  # show the initial cloud instead of the trained model


class TrialPainter:
    """Draws one trial from any camera; several threads may draw at once, as with its rasterizer."""

    def __init__(self, trial: ViewedTrial, rasterizer: Rasterizer) -> None:
        self.trial, self.rasterizer = trial, rasterizer
        self._device = trial.gaussians.means.device
        background = torch.tensor(trial.background, dtype=torch.float32)  # [3]
        self._background = background.to(self._device)

    @cached_property
    def _by_opacity(self) -> Gaussians:
        """A copy sorted by opacity, most opaque first, so that a subset is a slice."""
        gaussians = self.trial.gaussians
        return gaussians.select(gaussians.opacity_logits.argsort(descending=True, stable=True))

    @cached_property
    def _initial(self) -> Gaussians:
        cloud = self.trial.cloud
        return gaussians_from_cloud(cloud.points, cloud.colors, self._device)

    @cached_property
    def _by_cause(self) -> Gaussians:
        """The Gaussians in the colours of their causes."""
        palette = torch.tensor([cause.color for cause in Cause], device=self._device) / 255
        causes = torch.from_numpy(self.trial.causes.astype(np.int64)).to(self._device)  # [N]
        return replace(self.trial.gaussians, sh_dc=rgb_to_dc(palette[causes]))

    def draw(self, camera: Camera, layers: Layers) -> Picture:
        """The trial from ``camera``, [H, W, 3] uint8; by default as the evaluation renders it."""
        gaussians = self._initial if layers.cloud else self.trial.gaussians
        if not layers.cloud and layers.share < 100:
            count = max(1, round(layers.share / 100 * len(gaussians)))
            gaussians = self._by_opacity.map(lambda tensor: tensor[:count])
        image = self._render(gaussians, camera, layers.sh_degree, self._background).image
        large = self.above(layers.log10_volume)
        if layers.causes and len(large):
            black = torch.zeros_like(self._background)
            shown = self._by_cause.select(torch.from_numpy(large).to(self._device))
            front = self._render(shown, camera, 0, black)
            image = front.image + (1 - front.alpha.unsqueeze(-1)) * DIMMED * image
        return quantize(image).cpu().numpy()

    def above(self, log10_volume: float) -> NDArray[np.int64]:
        """Indices of the Gaussians whose volume is above the threshold."""
        return np.flatnonzero(self.trial.log10_volumes > log10_volume)

    def counts_above(self, log10_volume: float) -> dict[Cause, int]:
        """Count the Gaussians above the volume by cause."""
        counts = np.bincount(self.trial.causes[self.above(log10_volume)], minlength=len(Cause))
        return {cause: int(counts[cause]) for cause in Cause}

    def _render(
        self, gaussians: Gaussians, camera: Camera, degree: int, background: torch.Tensor
    ) -> RenderOutput:
        with torch.no_grad():
            return self.rasterizer.render(gaussians, camera, degree, background)


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
    row = np.hstack([picture for _, picture in panes])
    image = Image.fromarray(row)
    draw = ImageDraw.Draw(image)
    left = 0
    for label, picture in panes:
        height, width = picture.shape[:2]
        text, size = _fitted(label, TEXT_SIZE * height, width)
        if left:
            draw.line([(left, 0), (left, height)], fill=TEXT_COLOR)
        at, font = (left + MARGIN * size, MARGIN * size), ImageFont.load_default(size)
        shadow: dict[str, Any] = {"stroke_width": max(1, round(size / 8)), "stroke_fill": SHADOW}
        draw.text(at, text, TEXT_COLOR, font, **shadow)
        left += width
    return np.asarray(image)


def _fitted(label: str, size: float, width: int) -> tuple[str, float]:
    """The label in lines that fit ``width`` px, and the text size, reduced for a long word."""
    length, space = ImageFont.load_default(size).getlength, width - 2 * MARGIN * size
    first, *rest = label.split()
    lines = [first]
    for word in rest:
        if length(f"{lines[-1]} {word}") <= space:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return "\n".join(lines), size * min(1.0, space / max(map(length, lines)))
