"""The definition of the photometric loss of 3DGS in plain torch, and its constants: ``(1 - w) L1 + w (1 - SSIM)``.

SSIM (Wang et al. 2004) with an 11x11 Gaussian window of sigma 1.5, zero padding, the mean of the full map, as in the
reference implementation of 3DGS; w = 0.2.
"""

from __future__ import annotations

import torch
from torch import Tensor

SSIM_WEIGHT = 0.2
WINDOW_RADIUS = 5  # px; 11 taps
WINDOW_SIGMA = 1.5  # px
C1 = 0.01**2
C2 = 0.03**2


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
    # Made on the device: an upload would make the host wait.
    offsets = torch.arange(-WINDOW_RADIUS, WINDOW_RADIUS + 1, dtype=torch.float64, device=device)
    weights = torch.exp(-0.5 * (offsets / WINDOW_SIGMA) ** 2)
    return (weights / weights.sum()).to(dtype)


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
