"""The photometric loss of 3DGS: ``(1 - w) L1 + w (1 - SSIM)`` with w = 0.2.

SSIM (Wang et al. 2004) with an 11x11 Gaussian window of sigma 1.5, zero padding, the mean of the full map, as in the
reference implementation of 3DGS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from gsbench.pipeline.loss_cpu import CompiledLoss

SSIM_WEIGHT = 0.2
WINDOW_RADIUS = 5  # px; 11 taps
WINDOW_SIGMA = 1.5  # px
C1 = 0.01**2
C2 = 0.03**2


def photometric_loss(image: Tensor, target: Tensor, ssim_weight: float = SSIM_WEIGHT) -> tuple[Tensor, Tensor, Tensor]:
    """The loss, L1 and SSIM of ``image`` [H, W, 3] against ``target`` [H, W, 3] (uint8, taken as /255, or floating).

    Three scalars; only the loss carries a gradient, to ``image``. On the CPU in float32 this is a compiled kernel; a
    caller with many images keeps a ``PhotometricLoss`` instead, which has threads and keeps its memory.
    """
    return PhotometricLoss(ssim_weight, threads=1)(image, target)


class PhotometricLoss:
    """``photometric_loss`` as an object: CPU float32 images go through the compiled kernel on ``threads`` threads.

    The compiled path gives the same bits for any number of threads. Any other device or dtype goes through torch.
    """

    def __init__(self, ssim_weight: float = SSIM_WEIGHT, threads: int | None = None) -> None:
        if not 0 <= ssim_weight <= 1:
            raise ValueError(f"ssim_weight: must be between 0 and 1, got {ssim_weight}")
        self.ssim_weight = ssim_weight
        self._threads = threads
        self._compiled: CompiledLoss | None = None

    def __call__(self, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        if image.dim() != 3 or image.shape[-1] != 3 or image.shape != target.shape:
            raise ValueError(
                f"image {tuple(image.shape)} and target {tuple(target.shape)} must be of one shape [H, W, 3]"
            )
        if image.device.type != "cpu" or image.dtype != torch.float32:
            return torch_photometric_loss(image, target, self.ssim_weight)
        if self._compiled is None:
            from gsbench.pipeline.loss_cpu import CompiledLoss  # loads numba, which other devices need not have

            self._compiled = CompiledLoss(self.ssim_weight, self._threads)
        return self._compiled(image, target)


def torch_photometric_loss(
    image: Tensor, target: Tensor, ssim_weight: float = SSIM_WEIGHT
) -> tuple[Tensor, Tensor, Tensor]:
    """``photometric_loss`` in plain torch, for any device and floating dtype: the definition."""
    target = as_unit_range(target, image.dtype)
    l1 = (image - target).abs().mean()
    similarity = ssim_map(image, target).mean()
    loss = (1 - ssim_weight) * l1 + ssim_weight * (1 - similarity)
    return loss, l1.detach(), similarity.detach()


def as_unit_range(image: Tensor, dtype: torch.dtype) -> Tensor:
    """``image`` as ``dtype``; 8-bit values are divided by 255."""
    return image.to(dtype) / 255 if image.dtype == torch.uint8 else image.to(dtype)


def window(dtype: torch.dtype = torch.float64, device: torch.device | None = None) -> Tensor:
    """The one-dimensional Gaussian window [11], of sum 1."""
    offsets = torch.arange(-WINDOW_RADIUS, WINDOW_RADIUS + 1, dtype=torch.float64)
    weights = torch.exp(-0.5 * (offsets / WINDOW_SIGMA) ** 2)
    return (weights / weights.sum()).to(device=device, dtype=dtype)


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """SSIM at every pixel and channel, [3, H, W], of two images [H, W, 3] in [0, 1]."""
    x, y = (t.permute(2, 0, 1).unsqueeze(1) for t in (image, target))  # [3, 1, H, W]
    taps = window(image.dtype, image.device)

    def blur(t: Tensor) -> Tensor:
        t = torch.nn.functional.conv2d(t, taps.view(1, 1, 1, -1), padding=(0, WINDOW_RADIUS))
        return torch.nn.functional.conv2d(t, taps.view(1, 1, -1, 1), padding=(WINDOW_RADIUS, 0))

    mean_x, mean_y = blur(x), blur(y)
    variance_x, variance_y = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2
    covariance = blur(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    structure = (2 * covariance + C2) / (variance_x + variance_y + C2)
    return (luminance * structure).squeeze(1)
