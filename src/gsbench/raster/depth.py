"""Depth as one more image, from any executor of the contract."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsbench.gaussians.model import C0, Gaussians
from gsbench.raster.base import Rasterizer, RenderOutput
from gsbench.scene.types import Camera


def depth_colors(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """The Gaussians with their view z as grey colour, without harmonics.

    The colour of a Gaussian is ``0.5 + C0 sh_dc``, cut at 0 below; z is above 0 in front.
    """
    axis = gaussians.means.new_tensor(camera.rotation[2])
    z = gaussians.means @ axis + float(camera.translation[2])  # [N] world units
    grey = ((z - 0.5) / C0)[:, None].expand(-1, 3)
    return replace(gaussians, sh_dc=grey)


def render_depth(
    rasterizer: Rasterizer, gaussians: Gaussians, camera: Camera
) -> tuple[Tensor, RenderOutput]:
    """Expected depth along the camera's z, [H, W] world units: sum of w z over alpha.

    It is 0 where alpha is 0, and has gradients by all that z and the weights w depend on. Returns
    also the render of z as colour, whose ``screen_points`` get a gradient of their own.
    """
    black = torch.zeros(3, dtype=gaussians.means.dtype, device=gaussians.means.device)
    render = rasterizer.render(depth_colors(gaussians, camera), camera, 0, black)
    alpha = render.alpha
    # An alpha that is not 0 is at least that of one blended Gaussian, 1/255.
    depth = torch.where(alpha > 0, render.image[..., 0] / torch.where(alpha > 0, alpha, 1.0), 0.0)
    return depth, render
