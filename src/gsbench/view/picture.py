"""Pictures of trials from any camera: the render, and over it the initial cloud, ellipsoids and test cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

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
from gsbench.system.jit import inlined, kernel
from gsbench.view.trials import ViewedTrial

MAX_ELLIPSOIDS = 20_000  # the largest; more would hide one another
DIMMED = 0.35  # brightness of the render below ellipsoids or the cloud
FRUSTUM_DEPTH = 0.1  # of the distance of the cameras to their mean
LINE_COLOR, TEXT_COLOR, SHADOW_COLOR = (255, 210, 60), (255, 255, 255), (0, 0, 0)
TEXT_SIZE = 1 / 36  # of a picture's height; smaller where a label would not fit its pane
MARGIN = 0.5  # of the text's size
NEAR = 0.05  # world units: surfaces nearer than this are not drawn
AMBIENT = 0.35  # brightness of a surface seen edge-on; face-on it is 1
POINT_SIZE = 2  # px
Picture = NDArray[np.uint8]
Floats = NDArray[np.float64]


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
    """``image`` with the frustums of ``views``, in lines."""
    centers = np.stack([view.camera.center for view in views])  # [V, 3]
    depth = FRUSTUM_DEPTH * max(float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()), 1e-6)
    if len(views) == 1:
        depth = FRUSTUM_DEPTH * max(float(np.linalg.norm(centers[0])), 1.0)
    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture)
    for view in views:
        own = view.camera
        corners = np.array([[0, 0], [own.width, 0], [own.width, own.height], [0, own.height]], dtype=np.float64)
        rays = np.column_stack([(corners[:, 0] - own.cx) / own.fx, (corners[:, 1] - own.cy) / own.fy, np.ones(4)])
        world = (rays * depth - own.translation) @ own.rotation  # [4, 3]
        seen = np.vstack([own.center, world]) @ camera.rotation.T + camera.translation  # [5, 3]
        if seen[:, 2].min() <= NEAR:
            continue
        apex, *far = [(camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy) for x, y, z in seen]
        for first, second in zip(far, [*far[1:], far[0]], strict=True):
            draw.line([apex, first, second], fill=LINE_COLOR)
    return np.asarray(picture)


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


class Canvas:
    """A picture [H, W, 3] (floating point, 0 to 255) and the depth z of what was drawn so far, [H, W]."""

    def __init__(self, picture: NDArray[np.uint8], camera: Camera, brightness: float = 1.0) -> None:
        self.camera = camera
        self.picture = picture.astype(np.float64) * brightness
        self.depth = np.full(picture.shape[:2], np.inf)

    def points(self, points: Floats, colors: NDArray[np.uint8]) -> None:
        """Draw ``points`` [P, 3] (world) with ``colors`` [P, 3] as squares of ``POINT_SIZE`` px, nearest in front."""
        camera = self.camera
        seen = points @ camera.rotation.T + camera.translation  # [P, 3]
        order = np.argsort(-seen[:, 2])
        order = order[seen[order, 2] > NEAR]
        x, y, z = seen[order].T
        columns = np.floor(camera.fx * x / z + camera.cx).astype(np.int64)
        rows = np.floor(camera.fy * y / z + camera.cy).astype(np.int64)
        # Far to near, so that of several points in one pixel the nearest is written last.
        for shift_row in range(POINT_SIZE):
            for shift_column in range(POINT_SIZE):
                row, column = rows - shift_row, columns - shift_column
                inside = (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
                inside[inside] &= z[inside] < self.depth[row[inside], column[inside]] + 1e-9
                self.picture[row[inside], column[inside]] = colors[order[inside]]
                self.depth[row[inside], column[inside]] = z[inside]

    def ellipsoids(self, centers: Floats, rotations: Floats, semi_axes: Floats, colors: NDArray[np.uint8]) -> None:
        """Draw ellipsoids at ``centers`` [E, 3] (world); the columns of ``rotations`` [E, 3, 3] are their axes."""
        camera = self.camera
        seen = centers @ camera.rotation.T + camera.translation  # [E, 3]
        axes = camera.rotation @ rotations  # [E, 3, 3] in the camera
        to_sphere = np.swapaxes(axes / semi_axes[:, None, :], 1, 2)  # [E, 3, 3] the ellipsoid becomes the unit sphere
        _draw_ellipsoids(
            np.ascontiguousarray(seen),
            np.ascontiguousarray(to_sphere),
            np.ascontiguousarray(semi_axes.max(axis=1)),
            np.ascontiguousarray(colors),
            (camera.fx, camera.fy, camera.cx, camera.cy),
            self.picture,
            self.depth,
        )

    def image(self) -> NDArray[np.uint8]:
        return np.clip(np.rint(self.picture), 0, 255).astype(np.uint8)


@inlined
def _range(focal: float, principal: float, x: float, z: float, radius: float, size: int) -> Any:
    """The pixels [first, end) along one axis that a sphere at (x, z) may cover."""
    if z - radius <= NEAR:
        return 0, size
    low = min((x - radius) / (z - radius), (x - radius) / (z + radius))
    high = max((x + radius) / (z - radius), (x + radius) / (z + radius))
    first = min(max(focal * low + principal - 0.5, 0.0), float(size))
    last = min(max(focal * high + principal + 0.5, 0.0), float(size))
    return int(first), int(last)


@kernel
def _draw_ellipsoids(
    centers: Any, to_sphere: Any, radii: Any, colors: Any, intrinsics: Any, picture: Any, depth: Any
) -> None:
    """Cast a ray d = (x, y, 1) through each pixel centre: the nearer root t of |M (t d - c)| = 1 is the surface's z."""
    fx, fy, cx, cy = intrinsics
    height, width = depth.shape
    for e in range(len(centers)):
        if centers[e, 2] + radii[e] <= NEAR:
            continue
        first_column, end_column = _range(fx, cx, centers[e, 0], centers[e, 2], radii[e], width)
        first_row, end_row = _range(fy, cy, centers[e, 1], centers[e, 2], radii[e], height)
        m, c = to_sphere[e], centers[e]
        px = m[0, 0] * c[0] + m[0, 1] * c[1] + m[0, 2] * c[2]
        py = m[1, 0] * c[0] + m[1, 1] * c[1] + m[1, 2] * c[2]
        pz = m[2, 0] * c[0] + m[2, 1] * c[1] + m[2, 2] * c[2]
        rest = px * px + py * py + pz * pz - 1.0
        for row in range(first_row, end_row):
            y = (row + 0.5 - cy) / fy
            for column in range(first_column, end_column):
                x = (column + 0.5 - cx) / fx
                qx = m[0, 0] * x + m[0, 1] * y + m[0, 2]
                qy = m[1, 0] * x + m[1, 1] * y + m[1, 2]
                qz = m[2, 0] * x + m[2, 1] * y + m[2, 2]
                a = qx * qx + qy * qy + qz * qz
                b = qx * px + qy * py + qz * pz
                inside = b * b - a * rest
                if inside <= 0.0:
                    continue
                z = (b - math.sqrt(inside)) / a
                if z <= NEAR or z >= depth[row, column]:
                    continue
                ux, uy, uz = z * qx - px, z * qy - py, z * qz - pz  # on the unit sphere
                nx = m[0, 0] * ux + m[1, 0] * uy + m[2, 0] * uz
                ny = m[0, 1] * ux + m[1, 1] * uy + m[2, 1] * uz
                nz = m[0, 2] * ux + m[1, 2] * uy + m[2, 2] * uz
                facing = -(nx * x + ny * y + nz) / math.sqrt((nx * nx + ny * ny + nz * nz) * (x * x + y * y + 1.0))
                light = AMBIENT + (1.0 - AMBIENT) * max(facing, 0.0)
                depth[row, column] = z
                for channel in range(3):
                    picture[row, column, channel] = light * colors[e, channel]
