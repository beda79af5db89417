"""The CUDA executor: gsplat's kernels (Ye et al., arXiv 2409.06765) under the contract of ``raster.base``.

gsplat's parts are put together here so that the conventions of 3DGS hold where its own ``rasterization`` has others:
the near plane is 0.2, and a Gaussian reaches the tiles of a square of 3 sigma along its larger axis, whatever its
opacity. What still differs, since it stands in gsplat's kernels: alpha is clamped to 0.999 instead of 0.99, and no
gradient passes the clamp; a tile at the edge of the square is taken in when any part of it is reached, not only its
first pixel; sums are made with atomics, so two runs differ in the last bits.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsbench.errors import InputError
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import CONSTANTS, RasterConstants, RenderOutput
from gsbench.raster.validate import check_inputs
from gsbench.scene.camera import Camera

MAX_RADIUS = 2**24  # px; keeps the tile arithmetic of an absurdly large Gaussian inside int32
COEFFICIENTS = {0: 1, 1: 4, 2: 9, 3: 16}  # harmonics up to each degree


class CudaRasterizer:
    """Renders with gsplat on a CUDA device; float32."""

    name = "cuda"

    def __init__(self, constants: RasterConstants = CONSTANTS) -> None:
        try:
            import gsplat
        except ImportError as error:
            raise InputError("raster=cuda needs gsplat: pip install 'gsbench[cuda]'") from error
        self.gsplat = gsplat
        self.constants = constants

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_degree: int,
        background: Tensor,
        absolute_gradient: bool = False,
    ) -> RenderOutput:
        check_inputs(gaussians, camera, sh_degree, background)
        constants, width, height = self.constants, camera.width, camera.height
        view, intrinsics = _matrices(camera, gaussians.means)
        quaternions = torch.nn.functional.normalize(gaussians.quaternions, dim=-1)
        radii, means, depths, conics, _ = self.gsplat.fully_fused_projection(
            gaussians.means,
            None,
            quaternions,
            gaussians.scales,
            view,
            intrinsics,
            width,
            height,
            eps2d=constants.blur,
            near_plane=constants.near,
        )  # radii [1, N, 2], means [1, N, 2] px, depths [1, N], conics [1, N, 3]
        seen = (radii > 0).all(-1)  # [1, N]
        square = _square_radii(conics.detach(), seen, constants)  # [1, N] int32
        tiles_x, tiles_y = -(-width // constants.tile), -(-height // constants.tile)
        both = square.unsqueeze(-1).expand(-1, -1, 2).contiguous()
        _, crossings, members = self.gsplat.isect_tiles(means, both, depths, constants.tile, tiles_x, tiles_y)
        offsets = self.gsplat.isect_offset_encode(crossings, 1, tiles_x, tiles_y)
        image, alpha = self.gsplat.rasterize_to_pixels(
            means,
            conics,
            self._colors(gaussians, camera, sh_degree, seen[0]).unsqueeze(0),
            gaussians.opacities.unsqueeze(0),
            width,
            height,
            constants.tile,
            offsets,
            members,
            backgrounds=background.unsqueeze(0),
            absgrad=absolute_gradient,
        )  # [1, H, W, 3], [1, H, W, 1]
        reached = _reaches_image(means.detach()[0], square[0], width, height)
        points = torch.zeros_like(gaussians.means[:, :2], requires_grad=True)
        out = RenderOutput(image[0], alpha[0, ..., 0], torch.where(reached, square[0], 0), points)
        if absolute_gradient:
            out.screen_gradient_abs = torch.zeros_like(points)
        if means.requires_grad:
            means.register_hook(lambda gradient: _deliver(gradient, means, out, width, height))
        return out

    def _colors(self, gaussians: Gaussians, camera: Camera, sh_degree: int, seen: Tensor) -> Tensor:
        directions = gaussians.means - gaussians.means.new_tensor(camera.center)  # [N, 3]; gsplat normalises
        used = gaussians.sh_rest[:, : COEFFICIENTS[sh_degree] - 1]
        coefficients = torch.cat([gaussians.sh_dc.unsqueeze(1), used], dim=1)  # [N, K, 3]
        rgb = self.gsplat.spherical_harmonics(sh_degree, directions, coefficients, masks=seen)
        return (rgb + 0.5).clamp_min(0)


def _matrices(camera: Camera, like: Tensor) -> tuple[Tensor, Tensor]:
    """World to camera [1, 4, 4] and intrinsics [1, 3, 3]."""
    view = torch.eye(4, dtype=like.dtype, device=like.device)
    view[:3, :3], view[:3, 3] = like.new_tensor(camera.rotation), like.new_tensor(camera.translation)
    intrinsics = like.new_tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    return view.unsqueeze(0), intrinsics.unsqueeze(0)


def _square_radii(conics: Tensor, seen: Tensor, constants: RasterConstants) -> Tensor:
    """ceil(3 sqrt(lambda_max)) px of the covariances whose inverses are ``conics`` [1, N, 3]; 0 where not ``seen``."""
    a, b, c = conics.double().unbind(-1)  # the inverse of the covariance: yy, -xy, xx over its determinant
    determinant = 1 / (a * c - b * b)
    middle = 0.5 * (a + c) * determinant
    root = (middle * middle - determinant).clamp_min(constants.eigenvalue_floor).sqrt()
    radii = (constants.sigma_extent * (middle + root).sqrt()).ceil().nan_to_num(0, 0, 0).clamp(0, MAX_RADIUS)
    return torch.where(seen, radii, 0.0).to(torch.int32)


def _reaches_image(means: Tensor, radii: Tensor, width: int, height: int) -> Tensor:
    """[N] bool: whether the square around the mean (px, first pixel centre at 0.5) touches the image."""
    x, y = means.unbind(-1)
    inside = (x + radii > 0) & (x - radii < width) & (y + radii > 0) & (y - radii < height)
    return inside & (radii > 0)


def _deliver(gradient: Tensor, means: Tensor, out: RenderOutput, width: int, height: int) -> None:
    """Hand the gradient of the projected means [1, N, 2] (1/px) to ``out`` in NDC units."""
    half_size = gradient.new_tensor([width / 2, height / 2])
    out.screen_points.grad = gradient[0] * half_size
    if out.screen_gradient_abs is not None:
        out.screen_gradient_abs += means.absgrad[0] * half_size  # type: ignore[attr-defined]  # set by gsplat's backward
