"""The photometric loss of 3DGS: 0.8 L1 + 0.2 (1 - SSIM)."""

from __future__ import annotations

import torch
from torch import Tensor

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2


def photometric_loss(image: Tensor, target: Tensor, ssim_weight: float = 0.2) -> tuple[Tensor, Tensor, Tensor]:
    """Loss, L1 and SSIM of ``image`` [H, W, 3] against ``target`` [H, W, 3] (uint8, or floating point in [0, 1])."""
    if target.dtype == torch.uint8:
        target = target.to(image.dtype) / 255
    l1 = (image - target).abs().mean()
    similarity = ssim(image, target)
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - similarity), l1, similarity


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM with an 11x11 Gaussian window of sigma 1.5 and zero padding, as 3DGS trains with it."""
    stack = torch.stack([image, target, image * image, target * target, image * target]).permute(0, 3, 1, 2)
    offsets = torch.arange(SSIM_WINDOW, dtype=image.dtype, device=image.device) - SSIM_WINDOW // 2
    window = torch.exp(-(offsets**2) / (2 * SSIM_SIGMA**2))
    window = window / window.sum()
    flat = stack.reshape(-1, 1, *stack.shape[-2:])  # [15, 1, H, W]
    blurred = torch.nn.functional.conv2d(flat, window.view(1, 1, 1, -1), padding=(0, SSIM_WINDOW // 2))
    blurred = torch.nn.functional.conv2d(blurred, window.view(1, 1, -1, 1), padding=(SSIM_WINDOW // 2, 0))
    mu_x, mu_y, xx, yy, xy = blurred.reshape(stack.shape)  # each [3, H, W]
    var_x, var_y, cov = xx - mu_x * mu_x, yy - mu_y * mu_y, xy - mu_x * mu_y
    score = ((2 * mu_x * mu_y + SSIM_C1) * (2 * cov + SSIM_C2)) / (
        (mu_x * mu_x + mu_y * mu_y + SSIM_C1) * (var_x + var_y + SSIM_C2)
    )
    return score.mean()
