"""Pictures of a trained model: maps of a view (depth, distance from the initial cloud, volume), and its voluminous
Gaussians drawn over a view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import cKDTree
from torch import Tensor

from gsbench.densify.volumetric import log_volume
from gsbench.events import Cause
from gsbench.gaussians.model import Gaussians, rgb_to_dc
from gsbench.raster.base import Rasterizer
from gsbench.raster.reference import project
from gsbench.scene.camera import Camera

MIN_ALPHA = 0.5  # a pixel that is covered less shows no surface: not a number


def view_maps(
    rasterizer: Rasterizer, gaussians: Gaussians, camera: Camera, initial_points: cKDTree
) -> dict[str, NDArray[np.float32]]:
    """Maps [H, W] of one view, NaN where no surface is seen; world units.

    ``depth``: view z, the mean over the Gaussians of a pixel weighted by their contribution. ``distance``: from the
    point at that depth to the nearest of ``initial_points``. ``volume``: of the Gaussians, the weighted geometric mean.
    """
    view_z = _view_z(gaussians, camera)
    volumes = log_volume(gaussians.log_scales)  # [N]
    lowest = volumes.min()
    features = torch.stack(
        [view_z.clamp_min(0), volumes - lowest, torch.zeros_like(view_z)], -1
    )  # [N, 3], none negative
    mean = _mean_seen(*paint(rasterizer, gaussians, features, camera))
    depth = mean[..., 0].double().cpu().numpy()  # [H, W]
    volume = torch.exp(mean[..., 1] + lowest).cpu().numpy()
    distance = np.full_like(depth, np.nan)
    covered = np.isfinite(depth)
    distance[covered] = initial_points.query(unproject(depth, camera)[covered])[0]
    maps = {"depth": depth, "distance": distance, "volume": volume}
    return {name: values.astype(np.float32) for name, values in maps.items()}


def paint(rasterizer: Rasterizer, gaussians: Gaussians, features: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """The Gaussians blended with ``features`` [N, 3], none negative, as colours: sums [H, W, 3], and alpha [H, W]."""
    painted = Gaussians(**(gaussians.tensors() | {"sh_dc": rgb_to_dc(features)}))
    with torch.no_grad():
        out = rasterizer.render(painted, camera, 0, torch.zeros_like(features[0]))
    return out.image, out.alpha


def _mean_seen(sums: Tensor, alpha: Tensor) -> Tensor:
    """Painted values, as a mean over the Gaussians of each pixel, [H, W, 3]; NaN where no surface is seen."""
    seen = (alpha >= MIN_ALPHA).unsqueeze(-1)
    return torch.where(seen, sums / alpha.clamp_min(MIN_ALPHA).unsqueeze(-1), math.nan)


def _view_z(gaussians: Gaussians, camera: Camera) -> Tensor:
    """[N], world units along the camera's axis."""
    return gaussians.means @ gaussians.means.new_tensor(camera.rotation[2]) + float(camera.translation[2])


def unproject(depth: NDArray[np.float64], camera: Camera) -> NDArray[np.float64]:
    """The world points [H, W, 3] of the pixel centres at ``depth`` [H, W] along z."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    x = (columns + 0.5 - camera.cx) / camera.fx * depth
    y = (rows + 0.5 - camera.cy) / camera.fy * depth
    in_view = np.stack([x, y, depth], -1)  # [H, W, 3]
    return (in_view - camera.translation) @ camera.rotation


OUTLINE_POINTS = 48
MAX_OUTLINES = 1500  # the most voluminous; more would hide the picture
MIN_OPACITY = 0.05  # fainter ones are not seen
FONT_SIZE, LINE_HEIGHT = 11, 14  # px, of the legend
TEXT_COLOR = (255, 255, 255)


def draw_ellipsoids(
    render: NDArray[np.uint8], gaussians: Gaussians, causes: torch.Tensor, camera: Camera, volume_threshold: float
) -> Image.Image:
    """The view ``render`` [H, W, 3] with the outlines of the Gaussians above ``volume_threshold`` (cubed scene units).

    An outline is the ellipsoid of one standard deviation, projected; its colour tells the rule that made the Gaussian
    (``causes`` [N], see ``Cause``). At most the 1500 most voluminous are drawn. A legend stands below the view.
    """
    volumes = log_volume(gaussians.log_scales)  # [N]
    large = (volumes > math.log(volume_threshold)) & (gaussians.opacities > MIN_OPACITY)
    index = large.nonzero().squeeze(-1)
    index = index[torch.argsort(volumes[index], descending=True)][:MAX_OUTLINES]
    projected = project(gaussians.select(index).map(lambda tensor: tensor.detach().double().cpu()), camera)
    image = Image.fromarray(render).convert("RGB")
    canvas = ImageDraw.Draw(image)
    angles = np.linspace(0, 2 * math.pi, OUTLINE_POINTS)
    circle = np.stack([np.cos(angles), np.sin(angles)])  # [2, K]
    for mean, conic, member in zip(projected.means, projected.conics, projected.index, strict=True):
        a, b, c = conic.tolist()
        covariance = np.linalg.inv(np.array([[a, b], [b, c]]))  # px^2
        outline = np.linalg.cholesky(covariance) @ circle + mean.numpy()[:, None]  # [2, K]
        color = Cause(int(causes[index[member]])).color
        canvas.line([tuple(point) for point in outline.T.round().astype(int).tolist()], fill=color, width=1)
    drawn = [cause for cause in Cause if (causes[index[projected.index]] == int(cause)).any()]
    large_ones = f"with a volume above {volume_threshold:g}"
    title = f"Gaussians {large_ones}, by what made them:" if drawn else f"no Gaussian {large_ones} here"
    return _with_legend(image, title, drawn)


def _with_legend(image: Image.Image, title: str, causes: Sequence[Cause]) -> Image.Image:
    """The image above a line of words and one of each cause in its colour, wrapped to its width."""
    words = [(word, TEXT_COLOR) for word in title.split()] + [(cause.words, cause.color) for cause in causes]
    font = ImageFont.load_default(FONT_SIZE)
    places: list[tuple[int, int]] = []
    x, row = 0, 0
    for text, _ in words:
        width = math.ceil(font.getlength(text)) + FONT_SIZE // 2
        if x > 0 and x + width > image.width:
            x, row = 0, row + 1
        places.append((x + 2, row))
        x += width
    height = (row + 1) * LINE_HEIGHT
    result = Image.new("RGB", (image.width, image.height + height))
    result.paste(image, (0, 0))
    canvas = ImageDraw.Draw(result)
    for (text, color), (left, line) in zip(words, places, strict=True):
        canvas.text((left, image.height + line * LINE_HEIGHT), text, fill=color, font=font)
    return result
