"""Scores by which Gaussians are drawn for growth: sums over the pixels of training views, and the draw."""

from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor

from gsbench.gaussians.model import C0, Gaussians
from gsbench.raster.base import RenderOutput

LUMINANCE = (19595, 38470, 7471)  # 2^16 times ITU-R 601-2, as Pillow turns RGB into L
HALF, SHIFT = 1 << 15, 16


class TrainingViews(Protocol):
    """The training views of a scene, for a densifier that looks at more of them than the one just rendered."""

    def __len__(self) -> int: ...

    def image(self, index: int) -> Tensor:
        """The photograph of a view, [H, W, 3] uint8 on the device of the Gaussians."""
        ...

    def render(self, index: int, gaussians: Gaussians, step: int) -> RenderOutput:
        """A view as the training renders it at iteration ``step``."""
        ...

    def dissimilarity(self, index: int, image: Tensor) -> Tensor:
        """The dissimilarity [H, W] of a rendered ``image`` [H, W, 3] and its view: max(0, 1 - SSIM), SSIM's mean over
        channels.
        """
        ...

    def loss(self, index: int, image: Tensor) -> Tensor:
        """The photometric loss of a rendered ``image`` [H, W, 3] of a view; a scalar."""
        ...


def draw_views(views: TrainingViews, count: int, rng: torch.Generator) -> list[int]:
    """``count`` different views, or all where there are fewer."""
    indices: list[int] = torch.randperm(len(views), generator=rng)[:count].tolist()
    return indices


def blended_sums(
    views: TrainingViews, index: int, gaussians: Gaussians, step: int, weights: Tensor
) -> tuple[Tensor, RenderOutput]:
    """Sum over pixels of w alpha T, [N, 3], of each Gaussian for three weights [H, W, 3]; and the render that it is of.

    alpha T is the derivative of a pixel with respect to the colour of the Gaussian, so the sum is the gradient of
    ``(image * weights).sum()`` with respect to it: any rasterizer gives it. Colours are set to grey, which none clamps.
    """
    probe = Gaussians(**{name: tensor.detach() for name, tensor in gaussians.tensors().items()})
    probe.sh_dc = torch.zeros_like(probe.sh_dc, requires_grad=True)
    probe.sh_rest = torch.zeros_like(probe.sh_rest)
    with torch.enable_grad():
        render = views.render(index, probe, step)
        (gradient,) = torch.autograd.grad(render.image, probe.sh_dc, weights)
    return gradient / C0, render


def edge_map(image: Tensor) -> Tensor:
    """The strength of edges in ``image`` [H, W, 3] uint8: [H, W] float32, from 0 to 1 (or all 0).

    Eight times the luminance of a pixel minus that of its eight neighbours, in 8 bits and clipped to them, then shifted
    and scaled to [0, 1]: what Pillow calls FIND_EDGES, but for the outermost pixels, which are 0 here.
    """
    rgb = image.to(torch.int32)
    level = (rgb[..., 0] * LUMINANCE[0] + rgb[..., 1] * LUMINANCE[1] + rgb[..., 2] * LUMINANCE[2] + HALF) >> SHIFT
    edges = torch.zeros_like(level)
    height, width = level.shape
    around = sum(level[y : height - 2 + y, x : width - 2 + x] for y in range(3) for x in range(3))
    edges[1:-1, 1:-1] = (9 * level[1:-1, 1:-1] - around).clamp(0, 255)
    return to_unit_range(edges.float())


def error_map(image: Tensor, photograph: Tensor) -> Tensor:
    """The mean absolute error of ``image`` [H, W, 3] over the channels, [H, W], shifted and scaled to [0, 1].

    ``photograph`` is [H, W, 3] uint8.
    """
    return to_unit_range((image - photograph.to(image) / 255).abs().mean(-1))


def to_unit_range(values: Tensor) -> Tensor:
    """``values`` shifted and scaled to [0, 1]; 0 where all are equal."""
    low, high = values.amin(), values.amax()
    return (values - low) / (high - low).clamp_min(torch.finfo(values.dtype).tiny)


def by_median(values: Tensor) -> Tensor:
    """``values`` [N] over the median of the positive ones (the lower of two); what is not positive becomes 0."""
    return _over(values, torch.median)


def by_mean(values: Tensor) -> Tensor:
    """``values`` [N] over the mean of the positive ones; what is not positive becomes 0."""
    return _over(values, torch.mean)


def _over(values: Tensor, middle: Callable[[Tensor], Tensor]) -> Tensor:
    positive = values > 0  # NaN is not
    if not positive.any():
        return torch.zeros_like(values)
    return torch.where(positive, values / middle(values[positive]), 0.0)


def edge_scores(
    views: TrainingViews,
    chosen: Sequence[int],
    gaussians: Gaussians,
    step: int,
    normalize: Callable[[Tensor], Tensor],
) -> Tensor:
    """The share of the photographs' edges that each Gaussian covers, [N]: the mean over the ``chosen`` views of sum
    over pixels of (edge strength) alpha T, each view's after ``normalize``.
    """
    total = torch.zeros_like(gaussians.opacity_logits)
    for index in chosen:
        edges = edge_map(views.image(index)).to(total.dtype).unsqueeze(-1)  # [H, W, 1]
        sums, _ = blended_sums(views, index, gaussians, step, edges.expand(-1, -1, 3).contiguous())
        total += normalize(sums[:, 0])
    return total / len(chosen)


def draw(candidates: Tensor, scores: Tensor, count: int, rng: torch.Generator) -> Tensor:
    """Mask [N] of ``count`` of the ``candidates`` [N], or of all, if there are fewer: drawn without replacement in
    proportion to their ``scores`` [N]; those without a score come last, in order.

    Efraimidis and Spirakis 2006: the smallest of e / score, with e ~ Exp(1). Drawn on the CPU, so that a seed means the
    same anywhere.
    """
    index = candidates.nonzero().squeeze(-1).cpu()  # [C]
    waits = torch.empty(len(index), dtype=torch.float64).exponential_(generator=rng) / scores.detach().cpu()[index]
    drawn = torch.zeros(len(candidates), dtype=torch.bool)
    drawn[index[torch.sort(waits, stable=True).indices[: max(count, 0)]]] = True
    return drawn.to(candidates.device)
