"""Pictures of trials from any camera: the render, the initial cloud, or large Gaussians coloured by their causes."""

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
from gsbench.gaussians.initial import gaussians_from_cloud
from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians, rgb_to_dc
from gsbench.gaussians.paper_values import VOLUME_THRESHOLD
from gsbench.raster.base import Rasterizer, RenderOutput
from gsbench.scene.types import Camera, View
from gsbench.view.trials import ViewedTrial

DIMMED = 0.35  # brightness of the render behind Gaussians coloured by their causes
TEXT_COLOR, SHADOW_COLOR = (255, 255, 255), (0, 0, 0)
TEXT_SIZE = 1 / 36  # of a picture's height; smaller if a word does not fit its pane
MARGIN = 0.5  # of the text's size
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Layers:
    """Settings of a picture."""

    sh_degree: int = MAX_SH_DEGREE
    max_gaussians: int | None = None  # keep only the most opaque; None: all
    causes: bool = False  # show the Gaussians above a volume in the colours of their causes
    log10_volume: float = math.log10(VOLUME_THRESHOLD)  # that volume
    cloud: bool = False  # show the initial cloud instead of the trained model


class TrialPainter:
    """Draws one trial from any camera. Like its rasterizer, it can be called from several threads."""

    def __init__(self, trial: ViewedTrial, rasterizer: Rasterizer) -> None:
        self.trial, self.rasterizer = trial, rasterizer
        self._device = trial.gaussians.means.device
        self._background = torch.tensor(trial.background, dtype=torch.float32, device=self._device)  # [3]

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
        palette = torch.tensor([cause.color for cause in Cause], device=self._device) / 255  # [C, 3]
        colors = palette[torch.from_numpy(self.trial.causes.astype(np.int64)).to(self._device)]  # [N, 3]
        return Gaussians(**(self.trial.gaussians.tensors() | {"sh_dc": rgb_to_dc(colors)}))

    def draw(self, camera: Camera, layers: Layers) -> Picture:
        """The trial from ``camera``, [H, W, 3] uint8. With default ``layers`` this is the evaluation's render."""
        gaussians = self._initial if layers.cloud else self.trial.gaussians
        limit = layers.max_gaussians
        if not layers.cloud and limit is not None and limit < len(gaussians):
            gaussians = self._by_opacity.map(lambda tensor: tensor[:limit])
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

    def _render(self, gaussians: Gaussians, camera: Camera, degree: int, background: torch.Tensor) -> RenderOutput:
        with torch.no_grad():
            return self.rasterizer.render(gaussians, camera, degree, background)


def photograph_at(camera: Camera, view: View) -> Picture:
    """The photograph of ``view`` resampled for the intrinsics of ``camera``, black outside the photograph."""
    own, photograph = view.camera, Image.fromarray(view.image)
    shrink = max(own.fx / camera.fx, own.fy / camera.fy)
    if shrink > 1:  # shrink with a filter first, because the transform below only interpolates neighbouring pixels
        own = own.resized(max(1, round(own.width / shrink)), max(1, round(own.height / shrink)))
        photograph = photograph.resize((own.width, own.height), Image.Resampling.BOX)
    sx, sy = own.fx / camera.fx, own.fy / camera.fy  # photograph pixels for one of the picture
    coefficients = (sx, 0, own.cx - sx * camera.cx, 0, sy, own.cy - sy * camera.cy)
    size = (camera.width, camera.height)
    return np.asarray(photograph.transform(size, Image.Transform.AFFINE, coefficients, Image.Resampling.BILINEAR))


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
        at, stroke = (left + MARGIN * size, MARGIN * size), max(1, round(size / 8))
        draw.text(at, text, TEXT_COLOR, ImageFont.load_default(size), stroke_width=stroke, stroke_fill=SHADOW_COLOR)
        left += width
    return np.asarray(image)


def _fitted(label: str, size: float, width: int) -> tuple[str, float]:
    """The label in lines that fit into ``width`` px, and the text size, which is reduced if a word does not fit."""
    length, room = ImageFont.load_default(size).getlength, width - 2 * MARGIN * size
    first, *rest = label.split()
    lines = [first]
    for word in rest:
        if length(f"{lines[-1]} {word}") <= room:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return "\n".join(lines), size * min(1.0, room / max(map(length, lines)))
