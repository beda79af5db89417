"""Image quality metrics by their exact definitions: PSNR, SSIM and FLIP, each as one value per image.

Images are torch tensors in [0, 1], either one image [H, W, 3] (the value is a 0-dimensional tensor) or a batch
[B, 3, H, W] (the values are [B]). LPIPS, which needs networks, has its own module.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.eval.protocol import FLIP_PPD, SsimPadding

# Wang et al. 2004, "Image quality assessment: from error visibility to structural similarity", for a data range of 1.
SSIM_WINDOW = 11  # px
SSIM_SIGMA = 1.5  # px
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2


def psnr(image: Tensor, target: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB, from the mean squared error over all pixels and channels of an image.

    Identical images give infinity; a protocol decides how that is reported.
    """
    _check_pair(image, target)
    squared = (image - target).square()
    mse = squared.mean() if image.ndim == 3 else squared.flatten(1).mean(dim=1)  # [] or [B]
    return -10.0 * mse.log10()


def ssim(image: Tensor, target: Tensor, padding: SsimPadding = "zero") -> Tensor:
    """Structural similarity with an 11x11 Gaussian window (sigma 1.5), averaged over pixels and channels.

    ``padding`` says what happens at the border: "zero" pads the images with zeros and averages the full map, as the
    evaluation of 3DGS does; "valid" averages over the pixels whose window lies inside the image, as scikit-image and
    torchmetrics do. Variances are those of the window as a population (no sample correction).
    """
    _check_pair(image, target)
    if padding not in ("zero", "valid"):
        raise ValueError(f"ssim padding is {padding!r}; choose zero or valid")
    single = image.ndim == 3
    x = _as_batch(image)  # [B, 3, H, W]
    y = _as_batch(target)  # [B, 3, H, W]
    if padding == "valid" and min(x.shape[-2:]) < SSIM_WINDOW:
        raise ValueError(f"ssim without padding needs images of at least {SSIM_WINDOW} px a side, got {tuple(x.shape)}")
    moments = _blur(torch.cat([x, y, x * x, y * y, x * y]), padding)  # [5B, 3, H', W']
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = moments.chunk(5)  # [B, 3, H', W'] each
    covariance = mean_xy - mean_x * mean_y
    variances = mean_xx - mean_x.square() + mean_yy - mean_y.square()
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x.square() + mean_y.square() + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variances + SSIM_C2)
    values = (luminance * structure).flatten(1).mean(dim=1)  # [B]
    return values[0] if single else values


def flip(image: Tensor, target: Tensor, ppd: float = FLIP_PPD) -> Tensor:
    """Mean FLIP error of sRGB images (0 identical, 1 worst) for a viewer who sees ``ppd`` pixels per degree.

    Andersson et al. 2020, "FLIP: a difference evaluator for alternating images", computed by NVIDIA's own library,
    ``flip-evaluator``; raises ModuleNotFoundError where that is not installed.
    """
    import flip_evaluator

    _check_pair(image, target)
    tests = _as_batch(image).permute(0, 2, 3, 1).float().cpu().contiguous().numpy()  # [B, H, W, 3]
    references = _as_batch(target).permute(0, 2, 3, 1).float().cpu().contiguous().numpy()  # [B, H, W, 3]
    means = [
        flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False, parameters={"ppd": ppd})[1]
        for reference, test in zip(references, tests, strict=True)
    ]
    values = torch.tensor(means, device=image.device)  # [B]
    return values[0] if image.ndim == 3 else values


def gaussian_window(dtype: torch.dtype, device: torch.device) -> Tensor:
    """The normalised 1D window of SSIM, [11]; its outer product with itself is the 2D window."""
    offsets = torch.arange(SSIM_WINDOW, dtype=dtype, device=device) - SSIM_WINDOW // 2  # [11]
    weights = torch.exp(-offsets.square() / (2 * SSIM_SIGMA**2))
    return weights / weights.sum()


def _blur(images: Tensor, padding: SsimPadding) -> Tensor:
    """Filter every channel of [B, C, H, W] with the window, one axis after the other."""
    if padding == "zero":
        images = F.pad(images, [SSIM_WINDOW // 2] * 4)
    window = gaussian_window(images.dtype, images.device).tolist()
    for axis in (2, 3):
        size = images.shape[axis] - SSIM_WINDOW + 1
        # Shifted sums: several times faster on a CPU than a depthwise convolution with one channel per group.
        blurred = images.narrow(axis, 0, size) * window[0]
        for offset, weight in enumerate(window[1:], start=1):
            blurred.add_(images.narrow(axis, offset, size), alpha=weight)
        images = blurred
    return images


def _as_batch(image: Tensor) -> Tensor:
    """[H, W, 3] or [B, 3, H, W] as [B, 3, H, W]."""
    return image.permute(2, 0, 1).unsqueeze(0) if image.ndim == 3 else image


def _check_pair(image: Tensor, target: Tensor) -> None:
    if image.shape != target.shape:
        raise ValueError(f"the images have different shapes: {tuple(image.shape)} and {tuple(target.shape)}")
    one = image.ndim == 3 and image.shape[-1] == 3
    batch = image.ndim == 4 and image.shape[1] == 3
    if not (one or batch):
        raise ValueError(f"an image is [H, W, 3] or a batch [B, 3, H, W], got {tuple(image.shape)}")
    if not (image.is_floating_point() and target.is_floating_point()):
        raise ValueError(f"images are floating point in [0, 1], got {image.dtype} and {target.dtype}")
