"""Pictures of a trained model for reports: which Gaussians are voluminous, and where they lie in a view."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from gsbench.densify.volume import log_volume
from gsbench.events import Cause
from gsbench.gaussians.model import Gaussians
from gsbench.raster.reference import project
from gsbench.scene.camera import Camera

OUTLINE_POINTS = 48
MAX_OUTLINES = 1500  # the most voluminous; more would hide the picture
MIN_OPACITY = 0.05  # fainter ones are not seen


def draw_ellipsoids(
    render: NDArray[np.uint8], gaussians: Gaussians, causes: torch.Tensor, camera: Camera, volume_threshold: float
) -> Image.Image:
    """The view ``render`` [H, W, 3] with the outlines of the Gaussians above ``volume_threshold`` (world units cubed).

    An outline is the ellipsoid of one standard deviation, projected; its colour tells the rule that made the Gaussian
    (``causes`` [N], see ``Cause``). At most the 1500 most voluminous are drawn.
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
    return image
