"""MS-SSIM and IW-SSIM: SSIM over five scales, the second weighted by the information at each position.

Both need images [H, W, 3] in [0, 1] with sides of at least 161 px, so that the window fits into the smallest scale.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.eval.images import LUMA, as_batch, check_pair, check_size, halved, mix_channels
from gsbench.eval.ssim import WINDOW_SIZE, ssim_parts

# Weights of the scales, from the finest: Wang, Simoncelli and Bovik 2003, section 3.2. IW-SSIM uses the same.
SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
SCALES = len(SCALE_WEIGHTS)
MIN_SIZE = (WINDOW_SIZE - 1) * 2 ** (SCALES - 1) + 1  # px: 161, halved four times and rounded up, is the window's 11
# Constants of IW-SSIM.
BYTE_RANGE = 255.0  # its model of vision is for values from 0 to 255
EYE_NOISE = 0.4  # variance of the visual noise: sigma_n², as in Sheikh and Bovik 2006, "Image information and..."
BLOCK = 3  # px, side of the neighbourhood whose coefficients are modelled as one vector
BINOMIAL = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)  # the filter of the pyramid, which is multiplied by sqrt(2)
FLAT = 1e-15  # smaller variances count as 0


def ms_ssim(image: Tensor, target: Tensor) -> Tensor:
    """Multi-scale structural similarity, the mean over the three channels; 1 for identical images, at least 0.

    Wang, Simoncelli and Bovik 2003, "Multiscale structural similarity for image quality assessment", eq. 7: contrast
    and structure at five scales, and luminance at the coarsest scale alone. Between scales, images are averaged over
    2x2 px; the last line of an odd side is repeated. A negative mean of a scale counts as 0. Raises ValueError for a
    side below 161 px.
    """
    check_pair(image, target)
    x, y = as_batch(image), as_batch(target)  # [B, 3, H, W] each
    check_size(x, MIN_SIZE, "MS-SSIM")
    values = torch.ones_like(x[:, :, 0, 0])  # [B, 3]
    for scale, weight in enumerate(SCALE_WEIGHTS):
        luminance, structure = ssim_parts(x, y, "valid")
        compared = structure if scale < SCALES - 1 else luminance * structure
        values = values * compared.mean(dim=(2, 3)).clamp_min(0) ** weight
        x, y = halved(x, "replicate"), halved(y, "replicate")
    means = values.mean(dim=1)  # [B]
    return means[0] if image.ndim == 3 else means


def iw_ssim(image: Tensor, target: Tensor) -> Tensor:
    """Information content weighted SSIM of the luminance: 1 for identical images, at least 0.

    Wang and Li 2011, "Information content weighting for perceptual image quality assessment", IEEE Trans. Image
    Processing 20(5). Contrast and structure in the bands of a Laplacian pyramid are weighted by the information that a
    noisy visual channel receives at each position. They are multiplied with SSIM in the lowest band, as in MS-SSIM. The
    absolute value of a scale's mean is used, as in piq. The value is NaN if ``target`` is flat. Raises ValueError for a
    side below 161 px.
    """
    check_pair(image, target)
    x, y = as_batch(image), as_batch(target)  # [B, 3, H, W] each
    check_size(x, MIN_SIZE, "IW-SSIM")
    values = [_iw_ssim(one, other) for one, other in zip(x.split(1), y.split(1), strict=True)]
    return values[0] if image.ndim == 3 else torch.stack(values)


def _iw_ssim(image: Tensor, target: Tensor) -> Tensor:
    """The value of one pair [1, 3, H, W]."""
    bands = _laplacian_pyramid(mix_channels(image, LUMA) * BYTE_RANGE)
    target_bands = _laplacian_pyramid(mix_channels(target, LUMA) * BYTE_RANGE)
    value = image.new_ones(())
    for scale, weight in enumerate(SCALE_WEIGHTS):
        band, target_band = bands[scale], target_bands[scale]  # [1, 1, h, w] each
        luminance, structure = ssim_parts(band, target_band, "valid", BYTE_RANGE)
        if scale == SCALES - 1:
            mean = (luminance * structure).mean()
        else:
            parent = target_bands[scale + 1] if scale < SCALES - 2 else None
            border = (WINDOW_SIZE - BLOCK) // 2  # the block fits at more positions than the window
            information = _information(band, target_band, parent)[border:-border, border:-border]
            mean = (structure[0, 0] * information).sum() / information.sum()
        share = weight / sum(SCALE_WEIGHTS)  # the weights sum to 1.0001; the authors normalise them for IW-SSIM
        value = value * mean.abs() ** share
    return value


def _laplacian_pyramid(image: Tensor) -> list[Tensor]:
    """Four bands of [1, 1, H, W] from the finest, then the low-pass rest; each is half as large as the one before."""
    kernel = image.new_tensor(BINOMIAL) * math.sqrt(2)  # [5]
    bands = []
    for _ in range(SCALES - 1):
        low = _filtered(image, kernel)[..., ::2, ::2]
        upsampled = torch.zeros_like(image)
        upsampled[..., ::2, ::2] = low
        bands.append(image - _filtered(upsampled, kernel))
        image = low
    return [*bands, image]


def _filtered(image: Tensor, kernel: Tensor) -> Tensor:
    """Filter [1, 1, H, W] along both axes, with mirrored borders."""
    reach = len(kernel) // 2
    padded = F.pad(image, [reach] * 4, mode="reflect")
    return F.conv2d(F.conv2d(padded, kernel.view(1, 1, 1, -1)), kernel.view(1, 1, -1, 1))


def _information(band: Tensor, target_band: Tensor, parent: Tensor | None) -> Tensor:
    """The information of both images about each block of a band, in half bits, [h - 2, w - 2].

    A block of the target, with the coefficient of the coarser band ``parent`` above it, is modelled as a Gaussian
    scale mixture: a Gaussian vector times a local factor. The image's block is the target's times ``gain`` plus noise.
    """
    blocks = F.unfold(target_band, BLOCK)[0].T  # [P, 9] for P blocks inside the band
    if parent is not None:
        above = _enlarged(parent)[..., : target_band.shape[-2], : target_band.shape[-1]]
        blocks = torch.cat([blocks, above[0, 0, 1:-1, 1:-1].reshape(-1, 1)], dim=1)  # [P, 10]
    count, size = blocks.shape
    # On the CPU, because not every device has this decomposition; the matrix is 10x10 at most.
    decomposition = torch.linalg.eigh((blocks.T @ blocks / count).cpu())
    variances, axes = (part.to(blocks) for part in decomposition)  # [K], [K, K]
    kept = variances > torch.finfo(variances.dtype).eps * variances.max()
    whitened = blocks @ axes[:, kept] / variances[kept].sqrt()  # [P, K']
    factor = whitened.square().sum(dim=1, keepdim=True) / size  # [P, 1] local variance: s²

    moments = F.avg_pool2d(torch.cat([band, target_band, band**2, target_band**2, band * target_band]), BLOCK, 1)
    mean, target_mean, square, target_square, product = moments[:, 0].flatten(1).unsqueeze(-1)  # [P, 1] each
    variance = (square - mean**2).clamp_min(0)
    target_variance = (target_square - target_mean**2).clamp_min(0)
    covariance = product - mean * target_mean
    flat, target_flat = variance < FLAT, target_variance < FLAT
    gain = torch.where(flat | target_flat, 0.0, covariance / target_variance.clamp_min(FLAT))
    noise = torch.where(target_flat, variance, variance - gain * covariance)
    noise = torch.where(flat, 0.0, noise)
    signal = (noise + (1 + gain**2) * EYE_NOISE) * factor * variances[kept] + EYE_NOISE * noise  # [P, K']
    height, width = target_band.shape[-2] - BLOCK + 1, target_band.shape[-1] - BLOCK + 1
    return torch.log2(1 + signal / EYE_NOISE**2).sum(dim=1).view(height, width)


def _enlarged(band: Tensor) -> Tensor:
    """[1, 1, h, w] enlarged twice: bilinear to 4h - 3 by 4w - 3, one line added on each side, every other line kept."""
    height, width = band.shape[-2:]
    fine = F.interpolate(band, (4 * height - 3, 4 * width - 3), mode="bilinear", align_corners=False)
    for axis in (2, 3):
        last = fine.shape[axis] - 1
        before = 2 * fine.narrow(axis, 0, 1) - fine.narrow(axis, 1, 1)
        after = 2 * fine.narrow(axis, last, 1) - fine.narrow(axis, last - 1, 1)
        fine = torch.cat([before, fine, after], dim=axis)
    return fine[..., ::2, ::2]
