"""Helpers that metrics and the loss share: values, masks and shapes of images, and luminance."""

import torch
from torch import Tensor

LUMA = (0.299, 0.587, 0.114)  # of red, green and blue: ITU-R BT.601


def as_unit_range(image: Tensor, dtype: torch.dtype) -> Tensor:
    """``image`` as ``dtype``; 8-bit values are divided by 255."""
    return image.to(dtype) / 255 if image.dtype == torch.uint8 else image.to(dtype)


def exact(image: Tensor) -> Tensor:
    """``image`` in double precision: in single, differences of moments are off by up to 2e-4 where an image is flat."""
    return image.to(torch.float32 if image.device.type == "mps" else torch.float64)


def where_counted(image: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
    """``image`` [H, W, 3] with the pixels of ``target`` (uint8 or floating) where ``mask`` [H, W, 1] is False.

    Both are equal there, so those pixels are no error and have no gradient; None: all pixels count.
    """
    return image if mask is None else torch.where(mask, image, as_unit_range(target, image.dtype))


def as_batch(image: Tensor) -> Tensor:
    """[H, W, 3] or [B, 3, H, W] as [B, 3, H, W]."""
    return image.permute(2, 0, 1).unsqueeze(0) if image.ndim == 3 else image


def check_pair(image: Tensor, target: Tensor) -> None:
    """Raise ValueError unless both are floating point, of one shape, [H, W, 3] or [B, 3, H, W]."""
    if image.shape != target.shape:
        raise ValueError(f"the images have different shapes: {tuple(image.shape)} and {tuple(target.shape)}")
    one = image.ndim == 3 and image.shape[-1] == 3
    batch = image.ndim == 4 and image.shape[1] == 3
    if not (one or batch):
        raise ValueError(f"an image is [H, W, 3] or a batch [B, 3, H, W], got {tuple(image.shape)}")
    if not (image.is_floating_point() and target.is_floating_point()):
        raise ValueError(f"images are floating point in [0, 1], got {image.dtype} and {target.dtype}")


def check_size(image: Tensor, smallest: int, metric: str) -> None:
    """Raise ValueError for a batch [B, 3, H, W] with a side below ``smallest`` px."""
    height, width = image.shape[-2:]
    if min(height, width) < smallest:
        raise ValueError(f"{metric} needs images of at least {smallest} px a side, got {width}x{height}")


def mix_channels(images: Tensor, weights: tuple[float, float, float]) -> Tensor:
    """The weighted sum of the channels of [B, 3, H, W] -> [B, 1, H, W]."""
    red, green, blue = weights
    return images[:, :1] * red + images[:, 1:2] * green + images[:, 2:] * blue


def similarity(first: Tensor, second: Tensor, constant: float) -> Tensor:
    """``(2 a b + c) / (a² + b² + c)`` of two maps of one shape: 1 where they are equal."""
    return (2 * first * second + constant) / (first.square() + second.square() + constant)


def gradient_magnitude(images: Tensor, smoothing: tuple[float, float, float]) -> Tensor:
    """The length of the gradient of [B, 1, H, W], zeros outside: central differences, smoothed across by 3 weights."""
    across = images.new_tensor(smoothing).unsqueeze(1) * images.new_tensor([-1.0, 0.0, 1.0])  # [3, 3]
    kernels = torch.stack([across, across.T]).unsqueeze(1)  # [2, 1, 3, 3]
    gradient = torch.nn.functional.conv2d(images, kernels, padding=1)  # [B, 2, H, W]
    return gradient.square().sum(dim=1, keepdim=True).sqrt()
