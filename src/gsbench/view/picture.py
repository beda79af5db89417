"""Pictures of trials from any camera: the render, and over it the initial cloud, ellipsoids and test cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from gsbench.eval.evaluator import quantize
from gsbench.events import Cause
from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians, quaternion_to_matrix
from gsbench.gaussians.paper_values import VOLUME_THRESHOLD
from gsbench.raster.base import Rasterizer
from gsbench.scene.camera import Camera
from gsbench.scene.types import View
from gsbench.view.ellipsoids import NEAR, Canvas
from gsbench.view.trials import ViewedTrial

MAX_ELLIPSOIDS = 20_000  # the largest; more would hide one another
DIMMED = 0.35  # brightness of the render below ellipsoids or the cloud
FRUSTUM_DEPTH = 0.1  # of the distance of the cameras to their mean
LINE_COLOR, TEXT_COLOR, SHADOW_COLOR = (255, 210, 60), (255, 255, 255), (0, 0, 0)
TEXT_SIZE = 1 / 36  # of a picture's height; smaller where a label would not fit its pane
MARGIN = 0.5  # of the text's size
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Layers:
    """Settings of a picture: ``max_gaussians`` keeps the most opaque (None: all), ellipsoids those above a volume."""

    sh_degree: int = MAX_SH_DEGREE
    max_gaussians: int | None = None
    ellipsoids: bool = False
    log10_volume: float = math.log10(VOLUME_THRESHOLD)
    cloud: bool = False
    cameras: bool = False


class TrialPainter:
    """Draws one trial from any camera; safe to call from several threads, as its rasterizer is."""

    def __init__(self, trial: ViewedTrial, rasterizer: Rasterizer) -> None:
        self.trial, self.rasterizer = trial, rasterizer
        device = trial.gaussians.means.device
        self._background = torch.tensor(trial.background, dtype=torch.float32, device=device)  # [3]
        self._by_volume = np.argsort(-trial.log10_volumes, kind="stable")  # [N]

    @cached_property
    def _by_opacity(self) -> Gaussians:
        """A copy with the most opaque first, so that a subset is a slice."""
        gaussians = self.trial.gaussians
        return gaussians.select(gaussians.opacity_logits.argsort(descending=True, stable=True))

    def draw(self, camera: Camera, layers: Layers) -> Picture:
        """The trial from ``camera``, [H, W, 3] uint8; without layers, just what the evaluation renders."""
        image = self._render(camera, layers)
        if layers.ellipsoids or layers.cloud:
            canvas = Canvas(image, camera, DIMMED)
            if layers.cloud:
                canvas.points(self.trial.cloud.points, self.trial.cloud.colors)
            if layers.ellipsoids:
                self._draw_ellipsoids(canvas, layers.log10_volume)
            image = canvas.image()
        return draw_cameras(image, camera, self.trial.views) if layers.cameras else image

    def above(self, log10_volume: float) -> NDArray[np.int64]:
        """Indices of the Gaussians whose volume is above the threshold, the largest first."""
        count = int((self.trial.log10_volumes > log10_volume).sum())
        return self._by_volume[:count]

    def counts_above(self, log10_volume: float) -> dict[Cause, int]:
        """Count the Gaussians above the volume by their causes."""
        counts = np.bincount(self.trial.causes[self.above(log10_volume)], minlength=len(Cause))
        return {cause: int(counts[cause]) for cause in Cause}

    def _render(self, camera: Camera, layers: Layers) -> Picture:
        gaussians: Gaussians = self.trial.gaussians
        limit = layers.max_gaussians
        if limit is not None and limit < len(gaussians):
            gaussians = self._by_opacity.map(lambda tensor: tensor[:limit])
        with torch.no_grad():
            out = self.rasterizer.render(gaussians, camera, layers.sh_degree, self._background)
        return quantize(out.image).cpu().numpy()

    def _draw_ellipsoids(self, canvas: Canvas, log10_volume: float) -> None:
        index = self.above(log10_volume)[:MAX_ELLIPSOIDS]
        chosen = torch.from_numpy(index)
        gaussians = self.trial.gaussians
        palette = np.array([cause.color for cause in Cause], dtype=np.uint8)
        canvas.ellipsoids(
            gaussians.means[chosen].double().cpu().numpy(),
            quaternion_to_matrix(gaussians.quaternions[chosen].double()).cpu().numpy(),
            gaussians.log_scales[chosen].double().exp().cpu().numpy(),
            palette[self.trial.causes[index]],
        )


def draw_cameras(image: Picture, camera: Camera, views: Sequence[View]) -> Picture:
    """``image`` with the frustums of ``views``, each with its photograph on the far side."""
    centers = np.stack([view.camera.center for view in views])  # [V, 3]
    size = FRUSTUM_DEPTH * max(float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()), 1e-6)
    if len(views) == 1:
        size = FRUSTUM_DEPTH * max(float(np.linalg.norm(centers[0])), 1.0)
    picture = Image.fromarray(image)
    order = np.argsort([-np.linalg.norm(center - camera.center) for center in centers])
    for index in order:
        _draw_frustum(picture, camera, views[index], size)
    return np.asarray(picture)


def _draw_frustum(picture: Image.Image, camera: Camera, view: View, depth: float) -> None:
    own = view.camera
    corners = np.array([[0, 0], [own.width, 0], [own.width, own.height], [0, own.height]], dtype=np.float64)
    rays = np.column_stack([(corners[:, 0] - own.cx) / own.fx, (corners[:, 1] - own.cy) / own.fy, np.ones(4)])
    world = (rays * depth - own.translation) @ own.rotation  # [4, 3]
    seen = np.vstack([own.center, world]) @ camera.rotation.T + camera.translation  # [5, 3]
    if seen[:, 2].min() <= NEAR:
        return
    pixels = [(camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy) for x, y, z in seen]
    across = np.abs(np.array(pixels)).max()
    if across > 4 * max(camera.width, camera.height):  # far outside: nothing to see, and much to paint
        return
    _paste_photograph(picture, camera, view, depth)
    draw = ImageDraw.Draw(picture)
    apex, *far = pixels
    for first, second in zip(far, [*far[1:], far[0]], strict=True):
        draw.line([apex, first], fill=LINE_COLOR)
        draw.line([first, second], fill=LINE_COLOR)


def _paste_photograph(picture: Image.Image, camera: Camera, view: View, depth: float) -> None:
    """Warp the photograph by the homography between its plane at ``depth`` and the picture."""
    own = view.camera
    to_plane = np.array([[1 / own.fx, 0, -own.cx / own.fx], [0, 1 / own.fy, -own.cy / own.fy], [0, 0, 1]]) * depth
    turn = camera.rotation @ own.rotation.T  # from the view's camera to the picture's
    shift = camera.translation - turn @ own.translation
    to_pixels = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    forward = to_pixels @ (turn @ to_plane + np.outer(shift, [0, 0, 1]))  # photograph (u, v, 1) to picture
    if abs(np.linalg.det(forward)) < 1e-12:  # seen edge-on
        return
    backward = np.linalg.inv(forward)
    backward /= backward[2, 2]
    coefficients = tuple(backward.ravel()[:8])
    photograph = Image.fromarray(view.image)
    mask = Image.new("L", photograph.size, 255)
    size, method = picture.size, Image.Transform.PERSPECTIVE
    warped = photograph.transform(size, method, coefficients, Image.Resampling.BILINEAR)
    picture.paste(warped, (0, 0), mask.transform(size, method, coefficients))


def photograph_at(camera: Camera, view: View) -> Picture:
    """The photograph of ``view`` with the intrinsics of ``camera``, black where it shows nothing."""
    own, photograph = view.camera, Image.fromarray(view.image)
    shrink = max(own.fx / camera.fx, own.fy / camera.fy)
    if shrink > 1:  # with a filter first, since the transform looks at single pixels
        own = own.resized(max(1, round(own.width / shrink)), max(1, round(own.height / shrink)))
        photograph = photograph.resize((own.width, own.height), Image.Resampling.BOX)
    sx, sy = own.fx / camera.fx, own.fy / camera.fy  # photograph pixels for one of the picture
    coefficients = (sx, 0, own.cx - sx * camera.cx, 0, sy, own.cy - sy * camera.cy)
    size = (camera.width, camera.height)
    return np.asarray(photograph.transform(size, Image.Transform.AFFINE, coefficients, Image.Resampling.BILINEAR))


def side_by_side(panes: Sequence[tuple[str, Picture]]) -> Picture:
    """Labelled pictures of one height, left to right."""
    row = np.hstack([picture for _, picture in panes])
    image = Image.fromarray(row)
    draw = ImageDraw.Draw(image)
    left = 0
    for label, picture in panes:
        height, width = picture.shape[:2]
        size = TEXT_SIZE * height
        size *= min(1.0, width / (ImageFont.load_default(size).getlength(label) + 2 * MARGIN * size))
        if left:
            draw.line([(left, 0), (left, height)], fill=TEXT_COLOR)
        at, stroke = (left + MARGIN * size, MARGIN * size), max(1, round(size / 8))
        draw.text(at, label, TEXT_COLOR, ImageFont.load_default(size), stroke_width=stroke, stroke_fill=SHADOW_COLOR)
        left += width
    return np.asarray(image)
