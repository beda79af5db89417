"""FSIM with colour (FSIMc), which compares phase congruency, gradients and colour of two images."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.eval.images import LUMA, as_batch, check_pair, check_size, gradient_magnitude, mix_channels, similarity

# Zhang, Zhang, Mou and Zhang 2011, "FSIM: a feature similarity index for image quality assessment", section III.
IN_PHASE = (0.596, -0.274, -0.322)  # I of YIQ
QUADRATURE = (0.211, -0.523, 0.312)  # Q
SCHARR = (3 / 16, 10 / 16, 3 / 16)
T_PHASE, T_GRADIENT, T_CHROMA = 0.85, 160.0, 200.0  # T1; T2; T3 = T4, for values from 0 to 255
CHROMA_POWER = 0.03  # lambda
SIDE = 256  # px: larger images are shrunk by the whole number nearest to shorter side / SIDE
MIN_SIZE = 16  # px; our choice: phases mean nothing in an image of less than three of the shortest waves
# Phase congruency, Kovesi 1999, "Image features from phase congruency", with the settings of section II of FSIM.
SCALES, ORIENTATIONS = 4, 4
SHORTEST_WAVE, WAVE_STEP = 6.0, 2.0  # px; factor between scales
BANDWIDTH = 0.55  # sigma of a log-Gabor filter over its frequency
ANGLE_SIGMA = math.pi / ORIENTATIONS / 1.2  # rad
LOW_PASS, LOW_PASS_ORDER = 0.45, 15  # cycles per px; a Butterworth filter that removes the corners of the spectrum
NOISE_SIGMAS = 2.0  # a response below the noise's mean plus so many standard deviations counts as zero
NOISE_EXCESS = 1.7  # factor by which the noise is overestimated for this measure
TINY = 1e-4  # avoids 0 / 0; for values from 0 to 255


def fsim(image: Tensor, target: Tensor) -> Tensor:
    """Feature similarity with colour of two images: 1 for identical images, at least 0.

    Images are [H, W, 3] in [0, 1] or a batch [B, 3, H, W] with values [B]. The value is NaN if neither image has any
    feature. Raises ValueError for a side below 16 px.
    """
    check_pair(image, target)
    x, y = as_batch(image) * 255, as_batch(target) * 255  # [B, 3, H, W] each
    check_size(x, MIN_SIZE, "FSIM")
    shrink = max(1, math.floor(min(x.shape[-2:]) / SIDE + 0.5))
    x, y = F.avg_pool2d(x, shrink), F.avg_pool2d(y, shrink)
    light_x, light_y = mix_channels(x, LUMA), mix_channels(y, LUMA)  # [B, 1, h, w], as all maps below
    phase_x, phase_y = phase_congruency(light_x), phase_congruency(light_y)
    contrast = similarity(gradient_magnitude(light_x, SCHARR), gradient_magnitude(light_y, SCHARR), T_GRADIENT)
    chroma = torch.ones_like(light_x)
    for weights in (IN_PHASE, QUADRATURE):
        chroma = chroma * similarity(mix_channels(x, weights), mix_channels(y, weights), T_CHROMA)
    features = torch.maximum(phase_x, phase_y)
    agreement = similarity(phase_x, phase_y, T_PHASE) * contrast
    # Opposite colours have a negative similarity, whose power is not real. As in piq and pyiqa, its size is used.
    local = agreement * chroma.abs() ** CHROMA_POWER
    values = (local * features).flatten(1).sum(dim=1) / features.flatten(1).sum(dim=1)  # [B]
    return values[0] if image.ndim == 3 else values


def phase_congruency(luminance: Tensor) -> Tensor:
    """The phase congruency of each pixel of [B, 1, H, W] (0 to 255), in [0, 1]: 1 at an ideal edge or line."""
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
    """The energy [B, O, 1, 1] that noise alone would reach, from the responses [B, O, H, W] of the finest scale."""
    median = finest.abs().square().flatten(2).median(dim=2).values  # [B, O]; chi-squared with 2 degrees of freedom
    power = median / math.log(2) / filters[:, 0].square().sum(dim=(1, 2))
    even = torch.fft.ifft2(filters.sum(dim=1)).real  # [O, H, W], the filters in space
    area = even.shape[1] * even.shape[2]
    tau = (power * even.square().sum(dim=(1, 2)) * area).sqrt()  # parameter of the Rayleigh distribution
    threshold = tau * (math.sqrt(math.pi / 2) + NOISE_SIGMAS * math.sqrt(2 - math.pi / 2))
    return (threshold / NOISE_EXCESS)[..., None, None]


def _log_gabor_filters(images: Tensor) -> Tensor:
    """Spectra [O, S, H, W] for [B, 1, H, W]: a log-Gaussian over the frequency times a Gaussian over the angle."""
    along = [_frequencies(size, images) for size in images.shape[-2:]]
    down, across = torch.meshgrid(along, indexing="ij")  # [H, W] each
    radius = torch.hypot(down, across)
    low_pass = 1 / (1 + (radius / LOW_PASS) ** (2 * LOW_PASS_ORDER))
    radius[0, 0] = 1  # avoids log(0); the filters are set to 0 at this frequency below
    angle = torch.atan2(-down, across)
    radial = []
    for scale in range(SCALES):
        frequency = 1 / (SHORTEST_WAVE * WAVE_STEP**scale)
        passed = torch.exp(-((radius / frequency).log() ** 2) / (2 * math.log(BANDWIDTH) ** 2)) * low_pass
        passed[0, 0] = 0
        radial.append(passed)
    angular = []
    for orientation in range(ORIENTATIONS):
        difference = angle - orientation * math.pi / ORIENTATIONS
        difference = torch.atan2(difference.sin(), difference.cos())  # in [-pi, pi]
        angular.append(torch.exp(-(difference**2) / (2 * ANGLE_SIGMA**2)))
    return torch.stack(angular).unsqueeze(1) * torch.stack(radial)


def _frequencies(size: int, like: Tensor) -> Tensor:
    """Frequencies of a Fourier transform in cycles per px; an odd size is reduced by 1, so that both ends are 0.5."""
    steps = torch.arange(size, dtype=like.dtype, device=like.device) - size // 2  # [size]
    return torch.fft.ifftshift(steps / (size - size % 2))
