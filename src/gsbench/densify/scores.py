"""Parts of several densifiers: draws, opacities, quantiles, and scores by training views."""

import math
from collections.abc import Callable, Sequence
from itertools import product
from typing import Protocol

import torch
from torch import Tensor

from gsbench.gaussians.model import C0, Gaussians
from gsbench.raster.base import RenderOutput

# Pillow's conversion of RGB to L: the weights of ITU-R 601-2 times 2^16, then a rounding shift by
# 16 bits.
LUMINANCE = (19595, 38470, 7471)
HALF, SHIFT = 1 << 15, 16


def standard_normal(shape: tuple[int, ...], rng: torch.Generator, like: Tensor) -> Tensor:
    """Draw normal numbers with the dtype and the device of ``like``.

    ``rng`` is a CPU generator. For another device, it seeds a temporary generator there, which
    draws the numbers. So no numbers are uploaded, and a checkpoint must save only the state of
    ``rng``. The same seed gives other numbers there than on the CPU.
    """
    if like.device.type == "cpu":
        return torch.randn(shape, generator=rng, dtype=like.dtype)
    seed = int(torch.randint(2**62, (1,), generator=rng))
    device_rng = torch.Generator(like.device).manual_seed(seed)
    return torch.randn(shape, generator=device_rng, dtype=like.dtype, device=like.device)


def lengths_of(vectors: Tensor) -> Tensor:
    """The lengths [N] of ``vectors`` [N, 2]."""
    if vectors.device.type != "cpu":
        return vectors.norm(dim=-1)
    x, y = vectors.unbind(1)  # on a CPU, three times as fast as torch's norm
    return torch.addcmul(x * x, y, y).sqrt_()


MIN_REVISED_OPACITY = 1e-6  # keeps the logit finite


def revised_logits(opacity_logits: Tensor) -> Tensor:
    """The logits of 1 - sqrt(1 - o) for opacities o (Revising Densification, arXiv 2404.06109).

    Two Gaussians of this opacity, one behind the other, are as opaque as one of opacity o.
    """
    transmittance = (-opacity_logits).sigmoid().sqrt()  # sqrt(1 - o)
    return torch.logit((1 - transmittance).clamp_min(MIN_REVISED_OPACITY))


def faded(opacity_logits: Tensor, factor: float) -> Tensor:
    """The logits of ``factor`` (at most 1) times the opacities."""
    return torch.logit(factor * opacity_logits.sigmoid())


def quantile(ordered: Tensor, q: float) -> float:
    """The ``q``-quantile of sorted values [N], interpolated linearly.

    Unlike torch.quantile, it accepts more than 16 M values.
    """
    position = q * (len(ordered) - 1)
    low = math.floor(position)
    high = min(low + 1, len(ordered) - 1)
    return float(ordered[low] + (position - low) * (ordered[high] - ordered[low]))


class TrainingViews(Protocol):
    """The training views of a scene, for densifiers that need more than the view just rendered."""

    def __len__(self) -> int: ...

    def image(self, index: int) -> Tensor:
        """The photograph of a view, [H, W, 3] uint8 on the device of the Gaussians."""

    def render(self, index: int, gaussians: Gaussians, step: int) -> RenderOutput:
        """Render a view as the training does at iteration ``step``."""

    def dissimilarity(self, index: int, image: Tensor) -> Tensor:
        """max(0, 1 - SSIM) of a rendered ``image`` [H, W, 3] and the photograph, [H, W].

        SSIM is the mean over channels.
        """

    def loss(self, index: int, image: Tensor) -> Tensor:
        """The photometric loss of a rendered ``image`` [H, W, 3]; a scalar."""


def draw_views(views: TrainingViews, count: int, rng: torch.Generator) -> list[int]:
    """Draw ``count`` different views, or all if there are fewer."""
    return torch.randperm(len(views), generator=rng)[:count].tolist()


def blended_sums(
    views: TrainingViews, index: int, gaussians: Gaussians, step: int, weights: Tensor
) -> tuple[Tensor, RenderOutput]:
    """The sum over pixels of w alpha T for each Gaussian, [N, 3], and the render of the view.

    ``weights`` w [H, W, 3] are three for each pixel. alpha T is the derivative of a pixel with
    respect to the colour of the Gaussian. So the sum is the gradient of ``(image * weights).sum()``
    with respect to that colour, which any rasterizer computes. All colours are set to grey, so that
    no rasterizer clamps them (a clamped colour has no gradient).
    """
    probe = gaussians.detach()
    probe.sh_dc = torch.zeros_like(probe.sh_dc, requires_grad=True)
    probe.sh_rest = torch.zeros_like(probe.sh_rest)
    with torch.enable_grad():
        render = views.render(index, probe, step)
        (gradient,) = torch.autograd.grad(render.image, probe.sh_dc, weights)
    return gradient / C0, render


def edge_map(image: Tensor) -> Tensor:
    """The strength of edges in ``image`` [H, W, 3] uint8: [H, W] float32 in [0, 1].

    It is eight times the luminance of a pixel minus the sum over its eight neighbours, clipped to 8
    bits, then shifted and scaled to [0, 1]; 0 in an image without edges. This is Pillow's
    FIND_EDGES, except that the outermost pixels are 0 here.
    """
    rgb = image.to(torch.int32)
    red, green, blue = LUMINANCE
    sums = rgb[..., 0] * red + rgb[..., 1] * green + rgb[..., 2] * blue
    luma = (sums + HALF) >> SHIFT
    edges = torch.zeros_like(luma)
    height, width = luma.shape
    shifts = product(range(3), repeat=2)
    block = sum(luma[y : height - 2 + y, x : width - 2 + x] for y, x in shifts)  # 3 x 3 pixels
    edges[1:-1, 1:-1] = (9 * luma[1:-1, 1:-1] - block).clamp(0, 255)
    return to_unit_range(edges.float())


def error_map(image: Tensor, photograph: Tensor) -> Tensor:
    """The absolute error of ``image`` [H, W, 3], shifted and scaled to [0, 1], [H, W].

    It is the mean over channels. ``photograph`` is [H, W, 3] uint8.
    """
    return to_unit_range((image - photograph.to(image) / 255).abs().mean(-1))


def to_unit_range(values: Tensor) -> Tensor:
    """``values`` shifted and scaled to [0, 1]; all 0 if they are equal."""
    low, high = values.amin(), values.amax()
    return (values - low) / (high - low).clamp_min(torch.finfo(values.dtype).tiny)


def by_median(values: Tensor) -> Tensor:
    """``values`` [N] divided by the (lower) median of the positive ones.

    Values that are not positive become 0.
    """
    return _normalized(values, torch.median)


def by_mean(values: Tensor) -> Tensor:
    """``values`` [N] divided by the mean of the positive ones.

    Values that are not positive become 0.
    """
    return _normalized(values, torch.mean)


def _normalized(values: Tensor, average: Callable[[Tensor], Tensor]) -> Tensor:
    positive = values > 0  # False for NaN
    if not positive.any():
        return torch.zeros_like(values)
    return torch.where(positive, values / average(values[positive]), 0.0)


def edge_scores(
    views: TrainingViews,
    indices: Sequence[int],
    gaussians: Gaussians,
    step: int,
    normalize: Callable[[Tensor], Tensor],
) -> Tensor:
    """Scores [N]: how strong the edges are, in photographs, that each Gaussian covers.

    In a view, the sum over pixels of (edge strength) alpha T is passed through ``normalize``. The
    score is the mean over the views ``indices``.
    """
    total = torch.zeros_like(gaussians.opacity_logits)
    for index in indices:
        edges = edge_map(views.image(index)).to(total.dtype).unsqueeze(-1)  # [H, W, 1]
        sums, _ = blended_sums(views, index, gaussians, step, edges.expand(-1, -1, 3).contiguous())
        total += normalize(sums[:, 0])
    return total / len(indices)


def draw(candidates: Tensor, scores: Tensor, count: int, rng: torch.Generator) -> Tensor:
    """Draw ``count`` of the ``candidates`` [N], or all if there are fewer; return a mask [N].

    The draw is without replacement, in proportion to ``scores`` [N]. Candidates with score 0 come
    last, in order of index. The method is that of Efraimidis and Spirakis (2006): take the smallest
    values of e / score with e ~ Exp(1). Random numbers are drawn on the CPU, so a seed gives the
    same draw on every device.
    """
    index = candidates.nonzero().squeeze(-1).cpu()  # [C]
    times = torch.empty(len(index), dtype=torch.float64).exponential_(generator=rng)
    keys = times / scores.cpu()[index]
    drawn = torch.zeros(len(candidates), dtype=torch.bool)
    drawn[index[torch.sort(keys, stable=True).indices[: max(count, 0)]]] = True
    return drawn.to(candidates.device)
