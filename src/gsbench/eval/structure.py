"""Metrics of structure: MS-SSIM, IW-SSIM and FSIM.

MS-SSIM and IW-SSIM are SSIM over five scales, the second weighted by the information at each
position. FSIM with colour (FSIMc) compares phase congruency, gradients and colour of two images.
"""

import math

import torch
import torch.nn.functional as F
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
from gsbench.eval.ssim import WINDOW_SIZE, ssim_parts

# Weights of the scales, from the finest: Wang, Simoncelli and Bovik 2003, section 3.2. IW-SSIM uses
# the same.
SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
SCALES = len(SCALE_WEIGHTS)
# px: 161, halved four times and rounded up, is the window's 11
MULTISCALE_MIN_SIZE = (WINDOW_SIZE - 1) * 2 ** (SCALES - 1) + 1
# Constants of IW-SSIM.
BYTE_RANGE = 255.0  # its model of vision is for values from 0 to 255
# variance of the visual noise: sigma_n², as in Sheikh and Bovik 2006, "Image information and
# visual quality"
EYE_NOISE = 0.4
BLOCK = 3  # px, side of the neighbourhood whose coefficients are modelled as one vector
# the filter of the pyramid, which is multiplied by sqrt(2)
BINOMIAL = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)
FLAT = 1e-15  # smaller variances count as 0


def ms_ssim(image: Tensor, target: Tensor) -> Tensor:
    """Multi-scale structural similarity, mean over channels: 1 for identical images, at least 0.

    Wang, Simoncelli and Bovik 2003, "Multiscale structural
    similarity for image quality assessment", eq. 7: contrast and structure at five scales, and
    luminance at the coarsest scale alone. Between scales, images are averaged over 2x2 px; the last
    line of an odd side is repeated. A negative mean of a scale counts as 0. Raises ValueError for a
    side below 161 px.
    """
    check_pair(image, target)
    x, y = as_batch(image), as_batch(target)  # [B, 3, H, W] each
    check_size(x, MULTISCALE_MIN_SIZE, "MS-SSIM")
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

    Wang and Li 2011, "Information content weighting for perceptual image quality assessment", IEEE
    Trans. Image Processing 20(5). Contrast and structure in the bands of a Laplacian pyramid are
    weighted by the information that a noisy visual channel receives at each position. They are
    multiplied with SSIM in the lowest band, as in MS-SSIM. The absolute value of a scale's mean is
    used, as in piq. The value is NaN if ``target`` is flat. Raises ValueError for a side below 161
    px.
    """
    check_pair(image, target)
    x, y = as_batch(image), as_batch(target)  # [B, 3, H, W] each
    check_size(x, MULTISCALE_MIN_SIZE, "IW-SSIM")
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
        # the weights sum to 1.0001; the authors normalise them for IW-SSIM
        share = weight / sum(SCALE_WEIGHTS)
        value = value * mean.abs() ** share
    return value


def _laplacian_pyramid(image: Tensor) -> list[Tensor]:
    """Four bands of [1, 1, H, W] from the finest, then the low-pass rest.

    Each has half the sides of the one before.
    """
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

    A block of the target, with the coefficient of the coarser band ``parent`` above it, is modelled
    as a Gaussian scale mixture: a Gaussian vector times a local factor. The image's block is the
    target's times ``gain`` plus noise.
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

    moments = F.avg_pool2d(
        torch.cat([band, target_band, band**2, target_band**2, band * target_band]), BLOCK, 1
    )
    # [P, 1] each
    mean, target_mean, square, target_square, product = moments[:, 0].flatten(1).unsqueeze(-1)
    variance = (square - mean**2).clamp_min(0)
    target_variance = (target_square - target_mean**2).clamp_min(0)
    covariance = product - mean * target_mean
    flat, target_flat = variance < FLAT, target_variance < FLAT
    gain = torch.where(flat | target_flat, 0.0, covariance / target_variance.clamp_min(FLAT))
    noise = torch.where(target_flat, variance, variance - gain * covariance)
    noise = torch.where(flat, 0.0, noise)
    # [P, K']
    signal = (noise + (1 + gain**2) * EYE_NOISE) * factor * variances[kept] + EYE_NOISE * noise
    height, width = target_band.shape[-2] - BLOCK + 1, target_band.shape[-1] - BLOCK + 1
    return torch.log2(1 + signal / EYE_NOISE**2).sum(dim=1).view(height, width)


def _enlarged(band: Tensor) -> Tensor:
    """Enlarge [1, 1, h, w] to [1, 1, 2h, 2w].

    It is interpolated bilinearly to 4h - 3 by 4w - 3 and extrapolated by one line on each side;
    then every other line is kept.
    """
    height, width = band.shape[-2:]
    fine = F.interpolate(
        band, (4 * height - 3, 4 * width - 3), mode="bilinear", align_corners=False
    )
    for axis in (2, 3):
        last = fine.shape[axis] - 1
        before = 2 * fine.narrow(axis, 0, 1) - fine.narrow(axis, 1, 1)
        after = 2 * fine.narrow(axis, last, 1) - fine.narrow(axis, last - 1, 1)
        fine = torch.cat([before, fine, after], dim=axis)
    return fine[..., ::2, ::2]


# Zhang, Zhang, Mou and Zhang 2011, "FSIM: a feature similarity index for image quality assessment",
# section III.
IN_PHASE = (0.596, -0.274, -0.322)  # I of YIQ
QUADRATURE = (0.211, -0.523, 0.312)  # Q
SCHARR = (3 / 16, 10 / 16, 3 / 16)
T_PHASE, T_GRADIENT, T_CHROMA = 0.85, 160.0, 200.0  # T1; T2; T3 = T4, for values from 0 to 255
CHROMA_POWER = 0.03  # lambda
SIDE = 256  # px: larger images are shrunk by the whole number nearest to shorter side / SIDE
# px; our choice: phases mean little in an image that holds few of the shortest waves
FSIM_MIN_SIZE = 16
# Phase congruency, Kovesi 1999, "Image features from phase congruency", with the settings of
# section II of FSIM.
WAVES, ORIENTATIONS = 4, 4
SHORTEST_WAVE, WAVE_STEP = 6.0, 2.0  # px; factor between scales
BANDWIDTH = 0.55  # sigma of a log-Gabor filter over its frequency
ANGLE_SIGMA = math.pi / ORIENTATIONS / 1.2  # rad
# cycles per px; a Butterworth filter that removes the corners of the spectrum
LOW_PASS, LOW_PASS_ORDER = 0.45, 15
# a response below the noise's mean plus this many standard deviations counts as zero
NOISE_SIGMAS = 2.0
NOISE_EXCESS = 1.7  # factor by which the noise is overestimated for this measure
TINY = 1e-4  # avoids 0 / 0; for values from 0 to 255


def fsim(image: Tensor, target: Tensor) -> Tensor:
    """Feature similarity with colour of two images: 1 for identical images, at least 0.

    Images are [H, W, 3] in [0, 1] or a batch [B, 3, H, W] with values [B]. The value is NaN if
    neither image has any feature. Raises ValueError for a side below 16 px.
    """
    check_pair(image, target)
    x, y = as_batch(image) * 255, as_batch(target) * 255  # [B, 3, H, W] each
    check_size(x, FSIM_MIN_SIZE, "FSIM")
    shrink = max(1, math.floor(min(x.shape[-2:]) / SIDE + 0.5))
    x, y = F.avg_pool2d(x, shrink), F.avg_pool2d(y, shrink)
    light_x, light_y = mix_channels(x, LUMA), mix_channels(y, LUMA)  # [B, 1, h, w], as all below
    phase_x, phase_y = phase_congruency(light_x), phase_congruency(light_y)
    contrast = similarity(
        gradient_magnitude(light_x, SCHARR), gradient_magnitude(light_y, SCHARR), T_GRADIENT
    )
    chroma = torch.ones_like(light_x)
    for weights in (IN_PHASE, QUADRATURE):
        chroma = chroma * similarity(mix_channels(x, weights), mix_channels(y, weights), T_CHROMA)
    features = torch.maximum(phase_x, phase_y)
    agreement = similarity(phase_x, phase_y, T_PHASE) * contrast
    # Opposite colours have a negative similarity, whose power is not real. As in piq and pyiqa, its
    # absolute value is used.
    local = agreement * chroma.abs() ** CHROMA_POWER
    values = (local * features).flatten(1).sum(dim=1) / features.flatten(1).sum(dim=1)  # [B]
    return values[0] if image.ndim == 3 else values


def phase_congruency(luminance: Tensor) -> Tensor:
    """The phase congruency of each pixel of [B, 1, H, W] (0 to 255), in [0, 1].

    It is 1 at an ideal edge or line.
    """
    filters = _log_gabor_filters(luminance)  # [O, S, H, W]
    spectrum = torch.fft.fft2(luminance).unsqueeze(1)  # [B, 1, 1, H, W]
    responses = torch.fft.ifft2(spectrum * filters)  # [B, O, S, H, W], real: even, imaginary: odd
    total = responses.sum(dim=2, keepdim=True)
    direction = total / (total.abs() + TINY)
    aligned = responses * direction.conj()
    energy = (aligned.real - aligned.imag.abs()).sum(dim=2)  # [B, O, H, W]
    energy = (energy - _noise(responses[:, :, 0], filters)).clamp_min(0).sum(dim=1)  # [B, H, W]
    amplitude = responses.abs().sum(dim=(1, 2))
    return (energy / (amplitude + TINY)).unsqueeze(1)


def _noise(finest: Tensor, filters: Tensor) -> Tensor:
    """The energy [B, O, 1, 1] of noise alone, from the finest responses [B, O, H, W]."""
    # [B, O]; chi-squared with 2 degrees of freedom
    median = finest.abs().square().flatten(2).median(dim=2).values
    power = median / math.log(2) / filters[:, 0].square().sum(dim=(1, 2))
    even = torch.fft.ifft2(filters.sum(dim=1)).real  # [O, H, W], the filters in space
    area = even.shape[1] * even.shape[2]
    # parameter of the Rayleigh distribution
    tau = (power * even.square().sum(dim=(1, 2)) * area).sqrt()
    threshold = tau * (math.sqrt(math.pi / 2) + NOISE_SIGMAS * math.sqrt(2 - math.pi / 2))
    return (threshold / NOISE_EXCESS)[..., None, None]


def _log_gabor_filters(images: Tensor) -> Tensor:
    """The spectra [O, S, H, W] of log-Gabor filters for images [B, 1, H, W].

    Each is a log-Gaussian over the frequency times a Gaussian over the angle.
    """
    along = [_frequencies(size, images) for size in images.shape[-2:]]
    down, across = torch.meshgrid(along, indexing="ij")  # [H, W] each
    radius = torch.hypot(down, across)
    low_pass = 1 / (1 + (radius / LOW_PASS) ** (2 * LOW_PASS_ORDER))
    radius[0, 0] = 1  # avoids log(0); the filters are set to 0 at this frequency below
    angle = torch.atan2(-down, across)
    radial = []
    for scale in range(WAVES):
        frequency = 1 / (SHORTEST_WAVE * WAVE_STEP**scale)
        octaves = (radius / frequency).log() ** 2
        passed = torch.exp(-octaves / (2 * math.log(BANDWIDTH) ** 2)) * low_pass
        passed[0, 0] = 0
        radial.append(passed)
    angular = []
    for orientation in range(ORIENTATIONS):
        difference = angle - orientation * math.pi / ORIENTATIONS
        difference = torch.atan2(difference.sin(), difference.cos())  # in [-pi, pi]
        angular.append(torch.exp(-(difference**2) / (2 * ANGLE_SIGMA**2)))
    return torch.stack(angular).unsqueeze(1) * torch.stack(radial)


def _frequencies(size: int, like: Tensor) -> Tensor:
    """Frequencies of a Fourier transform in cycles per px.

    An odd size is reduced by 1, so that both ends are 0.5.
    """
    steps = torch.arange(size, dtype=like.dtype, device=like.device) - size // 2  # [size]
    return torch.fft.ifftshift(steps / (size - size % 2))
