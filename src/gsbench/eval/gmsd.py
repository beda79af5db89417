"""GMSD: how unevenly the edges of two images agree."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from gsbench.eval.images import LUMA, as_batch, check_pair, check_size, gradient_magnitude, mix_channels, similarity

PREWITT = (1 / 3, 1 / 3, 1 / 3)
CONSTANT = 170 / 255**2  # their c = 170, for values from 0 to 255
MIN_SIZE = 2  # px: one mean of 2x2


def gmsd(image: Tensor, target: Tensor) -> Tensor:
    """Gradient magnitude similarity deviation of the luminance: 0 for identical images, less is better.

    Xue, Zhang, Mou and Bovik 2014, "Gradient magnitude similarity deviation: a highly efficient perceptual image
    quality index", section II: means of 2x2 px (zeros beyond an odd side), gradients by Prewitt's filter, their
    similarity at each pixel, and its standard deviation. Images are [H, W, 3] in [0, 1] or a
    batch [B, 3, H, W] with values [B].
    """
    check_pair(image, target)
    check_size(as_batch(image), MIN_SIZE, "GMSD")
    first, second = (gradient_magnitude(_halved_luminance(as_batch(x)), PREWITT) for x in (image, target))
    values = similarity(first, second, CONSTANT).flatten(1).std(dim=1, correction=0)  # [B]
    return values[0] if image.ndim == 3 else values


def _halved_luminance(images: Tensor) -> Tensor:
    """[B, 3, H, W] -> [B, 1, H / 2, W / 2], rounded up."""
    luminance = mix_channels(images, LUMA)
    height, width = luminance.shape[-2:]
    return F.avg_pool2d(F.pad(luminance, [0, width % 2, 0, height % 2]), 2)
