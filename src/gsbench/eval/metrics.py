"""PSNR, with one value per image.

Images are torch tensors in [0, 1], either one image [H, W, 3] (the value is a 0-dimensional tensor)
or a batch [B, 3, H, W] (the values are [B]).
"""

from torch import Tensor

from gsbench.eval.images import check_pair


def psnr(image: Tensor, target: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB, of the mean squared error over pixels and channels.

    Identical images give infinity, which a protocol replaces in reports.
    """
    check_pair(image, target)
    squared = (image - target).square()
    mse = squared.mean() if image.ndim == 3 else squared.flatten(1).mean(dim=1)  # [] or [B]
    return -10.0 * mse.log10()
