"""The readable definition of the rasterizer in torch, tile by tile.

It runs on any device, in float32 or float64. Tests compare the faster executors with this one in
float64. The formulas are those of EWA splatting (Zwicker et al. 2001) as in 3DGS (Kerbl et al.
2023); the constants are in ``raster.base.RasterConstants``.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gsbench.gaussians.model import Gaussians, colors
from gsbench.raster.base import CONSTANTS, Footprint, RenderOutput, slope_limits, view_depths
from gsbench.raster.splitting import SPLITTING_MATRIX, on_image, probed
from gsbench.raster.staged import check_inputs, make_probe
from gsbench.scene.types import Camera

Tile = tuple[slice, slice]  # the rows and the columns of a tile's pixels


@dataclass
class Projection:
    """The M Gaussians in front of the camera with a usable 2D covariance, in image space."""

    index: Tensor  # [M] into the N Gaussians
    means: Tensor  # [M, 2] px, integer pixel centres
    conics: Tensor  # [M, 3] inverse covariance: xx, xy, yy
    depths: Tensor  # [M] view z
    radii: Tensor  # [M] px


class ReferenceRasterizer:
    """The contract of ``raster.base`` in torch operations; autograd computes the gradients."""

    name = "reference"
    extras = SPLITTING_MATRIX

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_degree: int,
        background: Tensor,
        absolute_gradient: bool = False,
        extra: str | None = None,
    ) -> RenderOutput:
        check_inputs(gaussians, camera, sh_degree, background)
        # NDC to pixels
        half_size = gaussians.means.new_tensor([camera.width / 2, camera.height / 2])
        screen_points = torch.zeros_like(gaussians.means[:, :2], requires_grad=True)  # [N, 2] NDC
        gradient_abs = torch.zeros_like(screen_points) if absolute_gradient else None

        projected = project(gaussians, camera)
        index = projected.index
        tile_min, tile_max = tile_rectangles(projected, camera)
        reached = ((tile_max - tile_min) > 0).all(-1)  # [M]
        radii = torch.zeros(len(gaussians), dtype=torch.int32, device=gaussians.means.device)
        radii[index[reached]] = projected.radii[reached].to(torch.int32)

        means = projected.means + screen_points[index] * half_size  # [M, 2]
        probe = make_probe(self, extra, gaussians.means)
        image_probe = None
        if probe is not None:
            image_probe = on_image(probe[index], gaussians.means.detach()[index], camera)
        rgb = self._colors(gaussians, index, camera, sh_degree)  # [M, 3]
        opacities = gaussians.opacities[index]  # [M]

        # Adding zero connects the image with the graph even if no tile is reached, so that
        # ``backward`` always works.
        image = background.expand(camera.height, camera.width, 3) + 0 * screen_points.sum()
        alpha = torch.zeros(camera.height, camera.width, dtype=image.dtype, device=image.device)
        for members, tile in members_of_tiles(projected.depths, tile_min, tile_max, camera):
            pixels = pixel_centres(tile, image)
            # One mean per pixel, so that the hook sees the gradient of each pixel before the sum.
            pixel_means = means[members].expand(len(pixels), -1, -1)  # [P, K, 2]
            if gradient_abs is not None and pixel_means.requires_grad:
                pixel_means.register_hook(
                    _absolute_sum_into(gradient_abs, index[members], half_size)
                )
            # Recomputed in the backward pass: memory for intermediate results is that of one tile.
            tile_image, tile_alpha = checkpoint(
                composite,
                pixels,
                pixel_means,
                projected.conics[members],
                opacities[members],
                rgb[members],
                background,
                None if image_probe is None else image_probe[members],
                use_reentrant=False,
                preserve_rng_state=False,
            )
            alpha[tile] = tile_alpha.reshape(alpha[tile].shape)
            image[tile] = tile_image.reshape(*alpha[tile].shape, 3)
        footprint = partial(self._footprint, gaussians.map(torch.Tensor.detach), camera)
        return RenderOutput(image, alpha, radii, screen_points, gradient_abs, footprint, probe)

    @torch.no_grad()
    def _footprint(
        self, gaussians: Gaussians, camera: Camera, values: Tensor | None = None
    ) -> Footprint:
        sums, distances = gaussians.means.new_zeros(2, len(gaussians))
        covered = torch.zeros_like(sums, dtype=torch.int32)
        projected = project(gaussians, camera)
        tiles = members_of_tiles(projected.depths, *tile_rectangles(projected, camera), camera)
        # The K Gaussians of a tile, front to back, at its P pixels.
        for members, place in tiles:
            pixels = pixel_centres(place, gaussians.means)  # [P, 2]
            rows = projected.index[members]  # [K] into all Gaussians
            means = projected.means[members].expand(len(pixels), -1, -1)  # [P, K, 2] px
            conics, opacities = projected.conics[members], gaussians.opacities[rows]
            blended = blending_weights(pixels, means, conics, opacities) > 0  # [P, K]
            covered.index_add_(0, rows, blended.sum(0, dtype=torch.int32))
            apart = (means - pixels.unsqueeze(1)).norm(dim=-1)  # [P, K]
            distances.index_add_(0, rows, (apart * blended).sum(0))
            if values is not None:
                own = values[place].reshape(-1, 1).to(sums)  # [P, 1]
                sums.index_add_(0, rows, (own * blended).sum(0))
        return Footprint(covered, view_depths(gaussians, camera), sums, distances)

    @staticmethod
    def _colors(gaussians: Gaussians, index: Tensor, camera: Camera, sh_degree: int) -> Tensor:
        center = gaussians.means.new_tensor(camera.center)
        offsets = gaussians.means[index] - center
        directions = torch.nn.functional.normalize(offsets, dim=-1)  # [M, 3]
        return colors(gaussians.sh_dc[index], gaussians.sh_rest[index], directions, sh_degree)


def pixel_centres(tile: Tile, like: Tensor) -> Tensor:
    """The pixel centres of a tile, row by row, [P, 2] (x, y), with ``like``'s dtype and device."""
    rows, columns = (
        torch.arange(side.start, side.stop, dtype=like.dtype, device=like.device) for side in tile
    )
    return torch.cartesian_prod(rows, columns).flip(-1)


def project(gaussians: Gaussians, camera: Camera) -> Projection:
    """Project the Gaussians to the image plane, without those that cannot be rendered.

    These are nearer than ``near`` or have an unusable covariance. A first pass without a graph
    selects the usable ones, so that an overflow in another Gaussian cannot reach their gradients.
    """
    with torch.no_grad():
        depths = view_depths(gaussians, camera)  # [N]
        index = (depths > CONSTANTS.near).nonzero().squeeze(-1)  # [M]
        means, (xx, xy, yy), _ = _to_image(gaussians.select(index), camera)
        determinant = xx * yy - xy * xy  # [M]
        half_trace = 0.5 * (xx + yy)
        root = (half_trace * half_trace - determinant).clamp_min(CONSTANTS.eigenvalue_floor).sqrt()
        radii = (CONSTANTS.sigma_extent * (half_trace + root).sqrt()).ceil()
        usable = (
            (determinant > 0) & determinant.isfinite() & radii.isfinite() & means.isfinite().all(-1)
        )
        index, radii = index[usable], radii[usable].clamp_max(CONSTANTS.max_radius)
    means, (xx, xy, yy), z = _to_image(gaussians.select(index), camera)
    conics = torch.stack([yy, -xy, xx], -1) / (xx * yy - xy * xy).unsqueeze(-1)  # [M, 3]
    return Projection(index, means, conics, z.detach(), radii)


def _to_image(
    gaussians: Gaussians, camera: Camera
) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor], Tensor]:
    """Project the Gaussians, which are all in front of the camera.

    Returns the means [M, 2] px; the entries xx, xy, yy of the blurred 2D covariances, each [M],
    px^2; and the view depths [M].
    """
    rotation = gaussians.means.new_tensor(camera.rotation)  # [3, 3]
    translation = gaussians.means.new_tensor(camera.translation)  # [3]
    x, y, z = (gaussians.means @ rotation.T + translation).unbind(-1)  # each [M]
    left, right, top, bottom = slope_limits(camera)
    slope_x, slope_y = (x / z).clamp(left, right), (y / z).clamp(top, bottom)
    zero = torch.zeros_like(z)
    row_x = torch.stack([camera.fx / z, zero, -camera.fx * slope_x / z], -1)
    row_y = torch.stack([zero, camera.fy / z, -camera.fy * slope_y / z], -1)
    jacobian = torch.stack([row_x, row_y], -2)  # [M, 2, 3]
    # 3DGS eq. 5 and 6: the covariance is J W R S (J W R S)^T.
    axes = gaussians.rotations * gaussians.scales.unsqueeze(-2)  # [M, 3, 3] columns: scaled axes
    image_axes = jacobian @ rotation @ axes  # [M, 2, 3]
    covariance = image_axes @ image_axes.mT  # [M, 2, 2]
    column = camera.fx * x / z + camera.cx - 0.5
    row = camera.fy * y / z + camera.cy - 0.5
    xx, yy = covariance[:, 0, 0] + CONSTANTS.blur, covariance[:, 1, 1] + CONSTANTS.blur
    return torch.stack([column, row], -1), (xx, covariance[:, 0, 1], yy), z


def tile_rectangles(projected: Projection, camera: Camera) -> tuple[Tensor, Tensor]:
    """The tiles that each Gaussian's square of side 2 radius touches.

    Returns the first and the past-the-last tile, both int64 [M, 2] (x, y).
    """
    tile = CONSTANTS.tile
    means, radii = projected.means.detach(), projected.radii.unsqueeze(-1)
    grid = means.new_tensor([-(-camera.width // tile), -(-camera.height // tile)])  # [2]
    zero = torch.zeros_like(grid)
    # Clamped before the conversion to int64, which is defined for numbers of this size only.
    first = ((means - radii) / tile).floor().clamp(zero, grid)
    past = ((means + radii + tile - 1) / tile).floor().clamp(zero, grid)
    return first.long(), past.long()


def members_of_tiles(
    depths: Tensor, tile_min: Tensor, tile_max: Tensor, camera: Camera
) -> Iterator[tuple[Tensor, Tile]]:
    """Yield each tile with Gaussians: the Gaussians [K], front to back, and the pixels.

    Gaussians of equal depth are in the order of their indices.
    """
    tile = CONSTANTS.tile
    order = torch.sort(depths, stable=True).indices  # [M]
    first, past = tile_min[order], tile_max[order]  # [M, 2]
    for y in range(0, camera.height, tile):
        for x in range(0, camera.width, tile):
            place = first.new_tensor([x // tile, y // tile])
            members = order[((first <= place) & (place < past)).all(-1)]
            if len(members):
                rows = slice(y, min(y + tile, camera.height))
                yield members, (rows, slice(x, min(x + tile, camera.width)))


def composite(
    pixels: Tensor,
    means: Tensor,
    conics: Tensor,
    opacities: Tensor,
    rgb: Tensor,
    background: Tensor,
    image_probe: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Blend K Gaussians, front to back, at P pixels (3DGS eq. 3).

    ``pixels`` [P, 2], ``means`` [P, K, 2], ``conics`` [K, 3], ``opacities`` [K], ``rgb`` [K, 3].
    Returns colours [P, 3] and opacities [P]. A pixel stops before the Gaussian that would lower its
    transmittance below ``transmittance_min``. For ``image_probe`` see ``blending_weights``.
    """
    weight = blending_weights(pixels, means, conics, opacities, image_probe)  # [P, K]
    opacity = weight.sum(1)  # [P]
    return weight @ rgb + (1 - opacity).unsqueeze(-1) * background, opacity


def blending_weights(
    pixels: Tensor,
    means: Tensor,
    conics: Tensor,
    opacities: Tensor,
    image_probe: Tensor | None = None,
) -> Tensor:
    """Alpha times transmittance, [P, K], for the arguments of ``composite``.

    0 where a Gaussian is not blended. For ``image_probe`` see `raster.splitting.probed`.
    """
    dx, dy = (means - pixels.unsqueeze(1)).unbind(-1)  # [P, K]
    power = -0.5 * (conics[:, 0] * dx * dx + conics[:, 2] * dy * dy) - conics[:, 1] * dx * dy
    raw = opacities * power.clamp_max(0).exp()  # [P, K]
    if image_probe is not None:
        raw = probed(raw, means - pixels.unsqueeze(1), conics, image_probe)
    # the gradient passes the clamp, as in 3DGS
    saturated = raw + (raw.clamp_max(CONSTANTS.alpha_max) - raw).detach()
    alpha = torch.where((power <= 0) & (raw >= CONSTANTS.alpha_min), saturated, 0.0)
    after = torch.cumprod(1 - alpha, dim=1)  # [P, K] transmittance behind each Gaussian
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    return torch.where(after >= CONSTANTS.transmittance_min, alpha * before, 0.0)


def _absolute_sum_into(buffer: Tensor, index: Tensor, half_size: Tensor):  # type: ignore[no-untyped-def]
    def add(gradient: Tensor) -> None:  # [P, K, 2] in 1/px
        buffer.index_add_(0, index, gradient.abs().sum(0) * half_size)

    return add
