"""A picture of a trained model: the outlines of its voluminous Gaussians drawn over a view."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from gsbench.densify.volumetric import log_volume
from gsbench.events import Cause
from gsbench.gaussians.model import Gaussians
from gsbench.raster.reference import project
from gsbench.scene.types import Camera

OUTLINE_POINTS = 48
MAX_OUTLINES = 1500  # of the most voluminous Gaussians; more outlines would hide the picture
MIN_OPACITY = 0.05  # fainter Gaussians are not seen
FONT_SIZE, LINE_HEIGHT = 11, 14  # px, of the legend
TEXT_COLOR = (255, 255, 255)


def draw_ellipsoids(
    render: NDArray[np.uint8], gaussians: Gaussians, causes: torch.Tensor, camera: Camera, volume_threshold: float
) -> Image.Image:
    """The view ``render`` [H, W, 3] with the outlines of the Gaussians above ``volume_threshold`` (cubed scene units).

    An outline is the projected ellipsoid of one standard deviation. Its colour tells the rule that made the Gaussian
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
    condition = f"with a volume above {volume_threshold:g}"
    title = f"Gaussians {condition}, by what made them:" if drawn else f"no Gaussian {condition} here"
    return _with_legend(image, title, drawn)


def _with_legend(image: Image.Image, title: str, causes: Sequence[Cause]) -> Image.Image:
    """The image with a legend below: the title, and each cause in its colour, wrapped to the image's width."""
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
