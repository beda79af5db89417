"""Depth as one more image, for any executor of the contract."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsbench.gaussians.model import C0, Gaussians
from gsbench.raster.base import Rasterizer, RenderOutput, view_depths
from gsbench.scene.types import Camera


def render_depth(
    rasterizer: Rasterizer, gaussians: Gaussians, camera: Camera
) -> tuple[Tensor, RenderOutput]:
    """Expected depth along the camera's z, [H, W] world units: sum of w z over alpha.

    It is 0 where alpha is 0, and has gradients by all that z and the weights w depend on. Returns
    also the render of z as colour, whose ``screen_points`` get a gradient of their own.
    """
    # z as grey: at degree 0 a colour is 0.5 + C0 sh_dc, cut at 0 below; z is above 0 in front.
    grey = ((view_depths(gaussians, camera) - 0.5) / C0)[:, None].expand(-1, 3)
    black = gaussians.means.new_zeros(3)
    render = rasterizer.render(replace(gaussians, sh_dc=grey), camera, 0, black)
    alpha = render.alpha
    # An alpha that is not 0 is at least that of one blended Gaussian, 1/255.
    depth = torch.where(alpha > 0, render.image[..., 0] / torch.where(alpha > 0, alpha, 1.0), 0.0)
    return depth, render
