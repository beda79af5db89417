"""gsplat's CUDA kernels (Ye et al., arXiv 2409.06765) behind gsbench's contract, to compare speeds.

    pip install -e '.[gsplat]'
    gsbench bench --raster triton,benchmarks.gsplat_raster.GsplatRasterizer
    gsbench ... raster._target_=benchmarks.gsplat_raster.GsplatRasterizer raster.name=gsplat

The contract is that of ``gsbench.raster.base``. This module calls gsplat's functions one by one, so
that the conventions of 3DGS hold, which gsplat's ``rasterization`` does not follow: the near plane
is 0.2, and a Gaussian reaches the tiles of a square of 3 sigma along its larger axis at any
opacity. It works with gsplat 1.5.3 and with 1.6, whose harmonics take other arguments. Some
differences are inside gsplat's kernels and remain:

- ``image`` and ``alpha``: gsplat 1.5 clamps alpha to 0.999 (1.6 to 0.99, as the contract), and the
  clamp blocks the gradient. A tile at the edge of the square is included if any part of it is
  reached, not only if its first pixel is.
- ``radii`` and ``visible``: a Gaussian is culled by a box of 3.33 sigma along each image axis, not
  by the square. If the square reaches the image but the box does not, the radius is 0; such a
  Gaussian would contribute less than 1/255 everywhere. Densifiers that count the iterations in
  which a Gaussian was visible count fewer.
- All gradients, also that of ``screen_points``: sums use atomics, so two runs differ in the last
  bits.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsbench.errors import InputError
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import CONSTANTS, RenderOutput
from gsbench.raster.staged import Readback, bad_values, check_settings, raise_for_values
from gsbench.scene.types import Camera
from gsbench.system.install import install_command

COEFFICIENTS = {0: 1, 1: 4, 2: 9, 3: 16}  # number of harmonics up to each degree


class GsplatRasterizer:
    """Renders with gsplat on a CUDA device, float32.

    ``library`` is the module ``gsplat`` or one with its functions.
    """

    name = "gsplat"

    def __init__(self, library: Any = None) -> None:
        if library is None:
            try:
                library = importlib.import_module("gsplat")
            except ImportError as error:
                raise InputError(f"needs gsplat: {install_command('gsplat')}") from error
        self.library = library
        # gsplat 1.5 takes directions, 1.6 means and poses.
        self._takes_directions = "dirs" in inspect.signature(library.spherical_harmonics).parameters
        self._cameras: WeakKeyDictionary[Camera, _DeviceCamera] = WeakKeyDictionary()

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_degree: int,
        background: Tensor,
        absolute_gradient: bool = False,
    ) -> RenderOutput:
        """See `gsbench.raster.base.Rasterizer`.

        Raises ValueError, which names the parameter, for an input that cannot be used.
        """
        check_settings(gaussians, camera, sh_degree, background)
        points = torch.zeros_like(gaussians.means[:, :2], requires_grad=True)
        absolute = torch.zeros_like(points) if absolute_gradient else None
        # gsplat's projection divides by the number of Gaussians, on the host
        if len(gaussians) == 0:
            return _empty(camera, background, points, absolute)
        bad = Readback(bad_values(gaussians, background))
        width, height, tile = camera.width, camera.height, CONSTANTS.tile
        on_device = self._on_device(camera, gaussians.means)
        # radii [1, N, 2], means [1, N, 2] px, depths [1, N], conics [1, N, 3]
        radii, means, depths, conics, _ = self.library.fully_fused_projection(
            gaussians.means,
            None,
            torch.nn.functional.normalize(gaussians.quaternions, dim=-1),
            gaussians.scales,
            on_device.view,
            on_device.intrinsics,
            width,
            height,
            eps2d=CONSTANTS.blur,
            near_plane=CONSTANTS.near,
        )
        seen = (radii > 0).all(-1)  # [1, N]
        square = _square_radii(conics.detach(), seen)  # [1, N] int32
        tiles_x, tiles_y = -(-width // tile), -(-height // tile)
        axis_radii = square.unsqueeze(-1).expand(-1, -1, 2).contiguous()
        _, pairs, members = self.library.isect_tiles(
            means, axis_radii, depths, tile, tiles_x, tiles_y
        )
        if bad.values():  # no wait: gsplat has just waited for the number of pairs
            raise_for_values(gaussians, background)
        offsets = self.library.isect_offset_encode(pairs, 1, tiles_x, tiles_y)
        rasterize = partial(
            self.library.rasterize_to_pixels,
            image_width=width,
            image_height=height,
            tile_size=tile,
            isect_offsets=offsets,
            flatten_ids=members,
            backgrounds=background.detach().unsqueeze(0),
            absgrad=absolute_gradient,
        )
        colors = self._colors(gaussians, on_device, sh_degree, seen)  # [N, 3]
        image, alpha = _Composite.apply(
            rasterize,
            on_device.half_size,
            absolute,
            means,
            conics,
            colors.unsqueeze(0),
            gaussians.opacities.unsqueeze(0),
            background,
            points,
        )
        reached = _reaches_image(means.detach()[0], square[0], width, height)
        return RenderOutput(image, alpha, torch.where(reached, square[0], 0), points, absolute)

    def _on_device(self, camera: Camera, like: Tensor) -> _DeviceCamera:
        """``camera`` as tensors with the dtype and on the device of ``like``, uploaded once."""
        cached = self._cameras.get(camera)
        if cached is None or cached.view.device != like.device or cached.view.dtype != like.dtype:
            cached = self._cameras[camera] = _DeviceCamera.of(camera, like)
        return cached

    def _colors(
        self, gaussians: Gaussians, camera: _DeviceCamera, sh_degree: int, seen: Tensor
    ) -> Tensor:
        used = gaussians.sh_rest[:, : COEFFICIENTS[sh_degree] - 1]
        coefficients = torch.cat([gaussians.sh_dc.unsqueeze(1), used], dim=1)  # [N, K, 3]
        harmonics = self.library.spherical_harmonics
        if self._takes_directions:  # [N, 3]; gsplat normalises
            rgb = harmonics(sh_degree, gaussians.means - camera.center, coefficients, masks=seen[0])
        else:
            rgb = harmonics(sh_degree, gaussians.means, camera.view, coefficients, masks=seen)[0]
        return (rgb + 0.5).clamp_min(0)


@dataclass(frozen=True)
class _DeviceCamera:
    """A camera as tensors for gsplat."""

    view: Tensor  # [1, 4, 4] world to camera
    intrinsics: Tensor  # [1, 3, 3]
    center: Tensor  # [3] world units
    half_size: Tensor  # [2] px: one unit of NDC

    @classmethod
    def of(cls, camera: Camera, like: Tensor) -> _DeviceCamera:
        view = np.eye(4)
        view[:3, :3], view[:3, 3] = camera.rotation, camera.translation
        intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        half_size = np.array([camera.width / 2, camera.height / 2])
        numbers = (view[None], intrinsics[None], camera.center, half_size)
        return cls(*map(like.new_tensor, numbers))


class _Composite(torch.autograd.Function):
    """gsplat's compositing in a graph of its own, so that ``backward`` gets the means' gradient.

    gsplat stores the absolute gradient as an attribute of the means that it was given. A hook on
    these means that reads the attribute would be a reference cycle through C++, which the garbage
    collector cannot free: the memory of every step would leak. This function avoids the cycle.
    """

    @staticmethod
    def forward(
        ctx: Any,
        rasterize: Callable[..., tuple[Tensor, Tensor]],
        half_size: Tensor,
        absolute: Tensor | None,
        means: Tensor,
        conics: Tensor,
        colors: Tensor,
        opacities: Tensor,
        background: Tensor,
        screen_points: Tensor,
    ) -> tuple[Tensor, Tensor]:
        needed = ctx.needs_input_grad
        # the screen points need the gradient of the means
        requires = (needed[3] or needed[8], *needed[4:7])
        leaves = (tensor.detach() for tensor in (means, conics, colors, opacities))
        ctx.leaves = [
            leaf.requires_grad_(flag) for leaf, flag in zip(leaves, requires, strict=True)
        ]
        with torch.enable_grad():
            ctx.outputs = rasterize(*ctx.leaves)  # [1, H, W, 3], [1, H, W, 1]
        ctx.half_size, ctx.absolute = half_size, absolute
        image, alpha = (output.detach() for output in ctx.outputs)
        return image[0], alpha[0, ..., 0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_image: Tensor, g_alpha: Tensor) -> tuple[Tensor | None, ...]:
        image, alpha = ctx.outputs
        g_outputs = g_image.unsqueeze(0), g_alpha.unsqueeze(0).unsqueeze(-1)
        wanted = [leaf for leaf in ctx.leaves if leaf.requires_grad]
        computed = iter(torch.autograd.grad((image, alpha), wanted, g_outputs, retain_graph=True))
        gradients = [next(computed) if leaf.requires_grad else None for leaf in ctx.leaves]
        g_means = gradients[0]
        g_screen = None if g_means is None else g_means[0] * ctx.half_size
        if ctx.absolute is not None and g_means is not None:
            ctx.absolute.add_(ctx.leaves[0].absgrad[0] * ctx.half_size)
        g_background = (
            (g_image * (1 - alpha.detach()[0])).sum((0, 1)) if ctx.needs_input_grad[7] else None
        )
        return None, None, None, *gradients, g_background, g_screen


def _empty(
    camera: Camera, background: Tensor, points: Tensor, absolute: Tensor | None
) -> RenderOutput:
    """Return the background, connected with the graph so that ``backward`` works."""
    zero = 0 * points.sum()
    image = background.expand(camera.height, camera.width, 3) + zero
    alpha = torch.zeros_like(image[..., 0]) + zero
    radii = torch.zeros_like(points[:, 0], dtype=torch.int32)
    return RenderOutput(image, alpha, radii, points, absolute)


def _square_radii(conics: Tensor, seen: Tensor) -> Tensor:
    """ceil(3 sqrt(lambda_max)) in px, [1, N] int32; 0 where ``seen`` is False.

    ``conics`` [1, N, 3] are the inverses of the covariances.
    """
    # the inverse of the covariance: yy, -xy, xx over its determinant
    a, b, c = conics.double().unbind(-1)
    determinant = 1 / (a * c - b * b)
    half_trace = 0.5 * (a + c) * determinant
    root = (half_trace * half_trace - determinant).clamp_min(CONSTANTS.eigenvalue_floor).sqrt()
    radii = (CONSTANTS.sigma_extent * (half_trace + root).sqrt()).ceil()
    radii = radii.nan_to_num(0, 0, 0).clamp(0, CONSTANTS.max_radius)
    return torch.where(seen, radii, 0.0).to(torch.int32)


def _reaches_image(means: Tensor, radii: Tensor, width: int, height: int) -> Tensor:
    """Mask [N]: whether the square of side 2 ``radii`` around the mean touches the image.

    All lengths are in px. The first pixel centre is at 0.5.
    """
    x, y = means.unbind(-1)
    inside = (x + radii > 0) & (x - radii < width) & (y + radii > 0) & (y - radii < height)
    return inside & (radii > 0)
