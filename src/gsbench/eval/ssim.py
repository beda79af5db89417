"""SSIM, with the window and constants that the metrics based on it and the training loss share.

Wang, Bovik, Sheikh and Simoncelli 2004, "Image quality assessment: from error visibility to
structural similarity": an 11x11 Gaussian window of sigma 1.5, constants for a data range of 1, and
population variances.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.eval.images import as_batch, check_pair, correlate
from gsbench.eval.protocol import SsimPadding

WINDOW_RADIUS = 5  # px
WINDOW_SIZE = 2 * WINDOW_RADIUS + 1  # px
WINDOW_SIGMA = 1.5  # px
C1 = 0.01**2
C2 = 0.03**2


def window() -> Tensor:
    """The one-dimensional Gaussian window, [11] float64 of sum 1.

    Its outer product with itself is the 2D window.
    """
    offsets = torch.arange(-WINDOW_RADIUS, WINDOW_RADIUS + 1, dtype=torch.float64)
    weights = torch.exp(-0.5 * (offsets / WINDOW_SIGMA) ** 2)
    return weights / weights.sum()


# plain numbers, because a tensor would have to be copied to each device
_WEIGHTS = window().tolist()


def ssim(
    image: Tensor, target: Tensor, padding: SsimPadding = "zero", mask: Tensor | None = None
) -> Tensor:
    """Structural similarity (eq. 13), averaged over pixels and channels.

    Images are [H, W, 3] in [0, 1] (the value is a 0-dimensional tensor) or a batch [B, 3, H, W]
    (the values are [B]). With ``padding`` "zero" the images are padded with zeros and the full map
    is averaged, as in the evaluation of 3DGS. With "valid" only pixels whose window lies inside the
    image count, as in scikit-image. With ``mask`` [H, W], for one image, only windows whose centre
    counts are averaged (NaN if none does). Raises ValueError for wrong shapes and sizes.
    """
    check_pair(image, target)
    height, width = as_batch(image).shape[2:]
    if padding == "valid" and min(height, width) < WINDOW_SIZE:
        raise ValueError(
            f"ssim without padding needs images of at least {WINDOW_SIZE} px a side, got "
            f"{width}x{height}"
        )
    values = _ssim_maps(as_batch(image), as_batch(target), padding)  # [B, 3, H', W']
    if mask is not None:
        inner = slice(WINDOW_RADIUS, -WINDOW_RADIUS) if padding == "valid" else slice(None)
        return values[0][:, mask[inner, inner]].mean()
    means = values.flatten(1).mean(dim=1)  # [B]
    return means[0] if image.ndim == 3 else means


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """SSIM at every pixel and channel, [3, H, W], of two images [H, W, 3] in [0, 1].

    The images are padded with zeros.
    """
    return _ssim_maps(as_batch(image), as_batch(target), "zero")[0]


def _ssim_maps(x: Tensor, y: Tensor, padding: SsimPadding) -> Tensor:
    """SSIM at every pixel, [B, C, H', W'], of images [B, C, H, W] with values from 0 to 1.

    It is luminance (eq. 6) times contrast and structure (eq. 9 times eq. 10, with C3 = C2 / 2).
    """
    moments = _blur(torch.cat([x, y, x * x, y * y, x * y]), padding)  # [5B, C, H', W']
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = moments.chunk(5)  # [B, C, H', W'] each
    covariance = mean_xy - mean_x * mean_y
    variances = mean_xx - mean_x.square() + mean_yy - mean_y.square()
    luminance = (2 * mean_x * mean_y + C1) / (mean_x.square() + mean_y.square() + C1)
    structure = (2 * covariance + C2) / (variances + C2)
    return luminance * structure


def _blur(images: Tensor, padding: SsimPadding) -> Tensor:
    """Filter every channel of [B, C, H, W] with the window, one axis after the other."""
    if padding == "zero":
        images = F.pad(images, [WINDOW_RADIUS] * 4)
    for axis in (2, 3):
        images = correlate(images, _WEIGHTS, axis)
    return images
