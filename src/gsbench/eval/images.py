"""Operations on images that metrics and the loss share."""

from collections.abc import Sequence

import torch
from torch import Tensor


def as_unit_range(image: Tensor, dtype: torch.dtype) -> Tensor:
    """``image`` as ``dtype``; 8-bit values are divided by 255."""
    return image.to(dtype) / 255 if image.dtype == torch.uint8 else image.to(dtype)


def in_double_precision(image: Tensor) -> Tensor:
    """``image`` in double precision, or single on MPS, which has no double.

    In single precision, differences of moments are wrong by up to 2e-4 in flat areas.
    """
    return image.to(torch.float32 if image.device.type == "mps" else torch.float64)


def replace_ignored(image: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    """``image`` [H, W, 3] with ``target``'s pixels where ``mask`` [H, W, 1] is False.

    ``target`` is uint8 or floating. The replaced pixels have no error and no gradient. With
    ``mask`` None all pixels count.
    """
    return image if mask is None else torch.where(mask, image, as_unit_range(target, image.dtype))


def as_batch(image: Tensor) -> Tensor:
    """[H, W, 3] or [B, 3, H, W] as [B, 3, H, W]."""
    return image.permute(2, 0, 1).unsqueeze(0) if image.ndim == 3 else image


def check_pair(image: Tensor, target: Tensor) -> None:
    """Raise ValueError unless both are floating point, of one shape [H, W, 3] or [B, 3, H, W]."""
    if image.shape != target.shape:
        raise ValueError(
            f"the images have different shapes: {tuple(image.shape)} and {tuple(target.shape)}"
        )
    is_image = image.ndim == 3 and image.shape[-1] == 3
    is_batch = image.ndim == 4 and image.shape[1] == 3
    if not (is_image or is_batch):
        raise ValueError(f"an image is [H, W, 3] or a batch [B, 3, H, W], got {tuple(image.shape)}")
    if not (image.is_floating_point() and target.is_floating_point()):
        raise ValueError(
            f"images are floating point in [0, 1], got {image.dtype} and {target.dtype}"
        )


def correlate(images: Tensor, weights: Sequence[float], axis: int) -> Tensor:
    """Weighted sums of neighbours along ``axis``, which gets ``len(weights) - 1`` px smaller."""
    size = images.shape[axis] - len(weights) + 1
    # Sums of shifted images are several times faster on a CPU than a depthwise convolution.
    total = images.narrow(axis, 0, size) * weights[0]
    for offset, weight in enumerate(weights[1:], start=1):
        total.add_(images.narrow(axis, offset, size), alpha=weight)
    return total
