"""Depth as one more image, for any executor of the contract."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsbench.gaussians.model import C0, Gaussians
from gsbench.raster.base import MEDIAN, Rasterizer, RenderOutput
from gsbench.raster.reference import (
    blending_weights,
    members_of_tiles,
    pixel_centres,
    project,
    tile_rectangles,
)
from gsbench.scene.types import Camera

AT_ONCE = 64  # Gaussians: most pixels are half opaque behind far fewer than their tile has


def depth_colors(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """The Gaussians with their view z as grey colour, without harmonics.

    The colour of a Gaussian is ``0.5 + C0 sh_dc``, cut at 0 below; z is above 0 in front.
    """
    z = _view_z(gaussians, camera)
    grey = ((z - 0.5) / C0)[:, None].expand(-1, 3)
    return replace(gaussians, sh_dc=grey)


def _view_z(gaussians: Gaussians, camera: Camera) -> Tensor:
    """z along the camera's axis, [N] world units, with its gradient."""
    axis = gaussians.means.new_tensor(camera.rotation[2])
    return gaussians.means @ axis + float(camera.translation[2])


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


def median_depth(rasterizer: Rasterizer, gaussians: Gaussians, camera: Camera) -> Tensor:
    """The z of the Gaussian at which the transmittance falls to a half, [H, W] world units.

    It is 0 where the transmittance stays above. Only that z has a gradient. An executor without
    ``median_gaussians`` lets the operations of the reference choose.
    """
    z = _view_z(gaussians, camera)
    choose = getattr(rasterizer, "median_gaussians", median_gaussians)
    chosen = choose(gaussians, camera)  # [H, W]
    return torch.where(chosen >= 0, z[chosen.clamp_min(0)], 0.0)


@torch.no_grad()
def median_gaussians(gaussians: Gaussians, camera: Camera) -> Tensor:
    """The Gaussian at which the transmittance falls to a half, [H, W]; -1 where none is."""
    like = gaussians.means
    chosen = torch.full((camera.height, camera.width), -1, device=like.device)
    projected = project(gaussians, camera)
    tiles = members_of_tiles(projected.depths, *tile_rectangles(projected, camera), camera)
    for members, tile in tiles:
        pixels = pixel_centres(tile, like)
        left = torch.ones_like(pixels[:, 0])  # [P] transmittance
        first = torch.full_like(left, -1, dtype=torch.int64)
        for part in members.split(AT_ONCE):
            index = projected.index[part]
            means = projected.means[part].expand(len(pixels), -1, -1)  # [P, K, 2]
            opacities = gaussians.opacities[index]
            weights = blending_weights(pixels, means, projected.conics[part], opacities)
            behind = left[:, None] * (1 - weights.cumsum(1))  # [P, K]
            reached = (behind <= MEDIAN) & (first < 0)[:, None]
            first = torch.where(reached.any(1), index[reached.int().argmax(1)], first)
            left = behind[:, -1]
            if bool((first >= 0).all()):
                break
        chosen[tile] = first.reshape(chosen[tile].shape)
    return chosen
