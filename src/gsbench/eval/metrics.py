"""PSNR and GMSD by their exact definitions, each with one value per image.

Images are torch tensors in [0, 1], either one image [H, W, 3] (the value is a 0-dimensional tensor)
or a batch [B, 3, H, W] (the values are [B]).
"""

from torch import Tensor

from gsbench.eval.images import (
    LUMA,
    as_batch,
    check_pair,
    check_size,
    gradient_magnitude,
    halved,
    mix_channels,
    similarity,
)


def psnr(image: Tensor, target: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB, of the mean squared error over pixels and channels.

    Identical images give infinity, which a protocol replaces in reports.
    """
    check_pair(image, target)
    squared = (image - target).square()
    mse = squared.mean() if image.ndim == 3 else squared.flatten(1).mean(dim=1)  # [] or [B]
    return -10.0 * mse.log10()


PREWITT = (1 / 3, 1 / 3, 1 / 3)
CONSTANT = 170 / 255**2  # the authors' c = 170 is for values from 0 to 255
GMSD_MIN_SIZE = 2  # px: one block of 2x2


def gmsd(image: Tensor, target: Tensor) -> Tensor:
    """Gradient magnitude similarity deviation of the luminance; 0 for identical images.

    Xue, Zhang, Mou and Bovik 2014, "Gradient magnitude
    similarity deviation: a highly efficient perceptual image quality index", section II. Images are
    averaged over 2x2 px (odd sides padded with zeros), Prewitt's filter gives the gradients, and
    the value is the standard deviation of their similarity over pixels.
    """
    check_pair(image, target)
    check_size(as_batch(image), GMSD_MIN_SIZE, "GMSD")
    first, second = (
        gradient_magnitude(halved(mix_channels(as_batch(x), LUMA), "constant"), PREWITT)
        for x in (image, target)
    )
    values = similarity(first, second, CONSTANT).flatten(1).std(dim=1, correction=0)  # [B]
    return values[0] if image.ndim == 3 else values
