"""A stand-in for the module ``gsplat`` on the CPU.

It has the signatures, shapes and side effects of the CUDA code of 1.5; `head` has those of 1.6.
Projection, intersections and harmonics are gsplat's own torch definitions. Compositing is written
here in plain torch. Its autograd function saves the means that it was given and stores the absolute
gradient as an attribute of them, as gsplat's does.
"""

import itertools
import sys
import weakref
from types import SimpleNamespace

import torch
from gsplat.cuda import _torch_impl as definitions

ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.999  # gsplat 1.5; the clamp blocks the gradient
TRANSMITTANCE_MIN = 1e-4

calls = []  # the names of the functions that were called
# one for every compositing in an autograd graph; it is dead when the graph is freed
graphs = []


def fully_fused_projection(
    means,
    covars,
    quats,
    scales,
    viewmats,
    Ks,  # noqa: N803 - gsplat's name
    width,
    height,
    eps2d=0.3,
    near_plane=0.01,
):
    calls.append("fully_fused_projection")
    if len(means) == 0:
        raise ZeroDivisionError(
            "gsplat's kernel divides by the number of Gaussians, and the process dies"
        )
    covariances, _ = definitions._quat_scale_to_covar_preci(quats, scales, True, False)
    radii, means2d, depths, conics, _ = definitions._fully_fused_projection(
        means, covariances, viewmats, Ks, width, height, eps2d=eps2d, near_plane=near_plane
    )
    return radii.detach(), means2d.contiguous(), depths, conics, None


def isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height):
    calls.append("isect_tiles")
    return definitions._isect_tiles(means2d, radii, depths, tile_size, tile_width, tile_height)


def isect_offset_encode(isect_ids, n_images, tile_width, tile_height):
    calls.append("isect_offset_encode")
    return definitions._isect_offset_encode(isect_ids, n_images, tile_width, tile_height)


def spherical_harmonics(degrees_to_use, dirs, coeffs, masks=None):
    calls.append("spherical_harmonics")
    colors = definitions._spherical_harmonics(degrees_to_use, dirs, coeffs)
    return colors if masks is None else torch.where(masks.unsqueeze(-1), colors, 0.0)


def head():
    """The stand-in for gsplat 1.6, whose harmonics take poses and check every shape."""

    def spherical_harmonics(degrees_to_use, means, viewmats, coeffs, masks=None):
        calls.append("spherical_harmonics of 1.6")
        cameras, count = len(viewmats), len(means)
        assert means.shape == (count, 3)
        assert viewmats.shape == (cameras, 4, 4)
        assert len(coeffs) == count
        assert masks is None or masks.shape == (cameras, count)
        centers = -(viewmats[:, :3, :3].transpose(1, 2) @ viewmats[:, :3, 3:])[
            ..., 0
        ]  # [C, 3] -R^T t
        colors = [
            definitions._spherical_harmonics(degrees_to_use, means - center, coeffs)
            for center in centers
        ]
        found = torch.stack(colors)  # [C, N, 3]
        return found if masks is None else torch.where(masks.unsqueeze(-1), found, 0.0)

    here = vars(sys.modules[__name__])
    return SimpleNamespace(**here | {"spherical_harmonics": spherical_harmonics})


def rasterize_to_pixels(
    means2d,
    conics,
    colors,
    opacities,
    image_width,
    image_height,
    tile_size,
    isect_offsets,
    flatten_ids,
    backgrounds=None,
    absgrad=False,
):
    calls.append("rasterize_to_pixels")
    settings = (image_width, image_height, tile_size, isect_offsets, flatten_ids, absgrad)
    return _Rasterize.apply(means2d, conics, colors, opacities, backgrounds, settings)


class _Rasterize(torch.autograd.Function):
    """Composites again in ``backward``, with a copy of the means for each pixel.

    So the absolute values of each pixel's gradient can be summed.
    """

    @staticmethod
    def forward(ctx, means2d, *rest):
        *tensors, settings = rest
        image, alpha, _ = _composite(means2d, *tensors, settings)
        ctx.save_for_backward(means2d, *tensors)
        ctx.settings = settings
        graphs.append(weakref.ref(ctx))
        return image, alpha

    @staticmethod
    def backward(ctx, g_image, g_alpha):
        means2d, *tensors = ctx.saved_tensors
        with torch.enable_grad():
            leaves = [tensor.detach().requires_grad_() for tensor in (means2d, *tensors[:3])]
            image, alpha, spread = _composite(*leaves, tensors[3], ctx.settings)
            joined = (
                (image * g_image).sum()
                + (alpha * g_alpha).sum()
                + 0 * sum(leaf.sum() for leaf in leaves)
            )
            wanted = [*leaves, *(copies for _, copies in spread)]
            found = torch.autograd.grad(joined, wanted, allow_unused=True)
        if ctx.settings[-1]:
            absolute = torch.zeros_like(means2d)
            for (members, _), gradient in zip(spread, found[4:], strict=True):
                absolute[0].index_add_(0, members, gradient.abs().sum(0))
            means2d.absgrad = absolute
        return *found[:4], None, None


def _composite(means2d, conics, colors, opacities, backgrounds, settings):
    """Return image [1, H, W, 3], alpha [1, H, W, 1] and a list with two tensors for each tile.

    These are the tile's Gaussians [K] and copies of their means for each pixel [P, K, 2].
    """
    width, height, tile, offsets, members, _ = settings
    bounds = [*offsets.flatten().tolist(), len(members)]
    tiles_x = offsets.shape[-1]
    image = backgrounds[0].expand(height, width, 3).clone()
    alpha = torch.zeros(height, width, 1, dtype=image.dtype)
    spread = []
    for k, (begin, end) in enumerate(itertools.pairwise(bounds)):
        if begin == end:
            continue
        index = members[begin:end].long()
        x0, y0 = k % tiles_x * tile, k // tiles_x * tile
        x1, y1 = min(x0 + tile, width), min(y0 + tile, height)
        rows, columns = torch.meshgrid(
            torch.arange(y0, y1) + 0.5, torch.arange(x0, x1) + 0.5, indexing="ij"
        )
        copies = means2d[0, index].expand(rows.numel(), -1, -1)  # [P, K, 2]
        spread.append((index, copies))
        dx, dy = (
            copies[..., 0] - columns.reshape(-1, 1),
            copies[..., 1] - rows.reshape(-1, 1),
        )  # [P, K]
        a, b, c = conics[0, index].unbind(-1)
        sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        raw = (opacities[0, index] * torch.exp(-sigma)).clamp_max(ALPHA_MAX)
        value = torch.where((sigma >= 0) & (raw >= ALPHA_MIN), raw, 0.0)
        after = torch.cumprod(1 - value, 1)
        before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], 1)
        weight = torch.where(after > TRANSMITTANCE_MIN, value * before, 0.0)
        opacity = weight.sum(1, keepdim=True)  # [P, 1]
        picture = weight @ colors[0, index] + (1 - opacity) * backgrounds[0]
        image[y0:y1, x0:x1] = picture.reshape(y1 - y0, x1 - x0, 3)
        alpha[y0:y1, x0:x1] = opacity.reshape(y1 - y0, x1 - x0, 1)
    return image.unsqueeze(0), alpha.unsqueeze(0), spread
