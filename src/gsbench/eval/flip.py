"""FLIP: how different two images look when they alternate at the same place.

Andersson et al. 2020, "FLIP: a difference evaluator for alternating images"; constants, separated
filters and repeated borders are those of the authors' code (github.com/NVlabs/flip, version 1.7).
That code adds up the mean in single precision and one pixel after the other, which makes it wrong
by 3 % for 16 megapixels. Images are as in `gsbench.eval.evaluator.psnr`.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from gsbench.eval.images import as_batch, check_pair, correlate, in_double_precision
from gsbench.eval.protocol import FLIP_PPD

# Linear sRGB to CIE XYZ with the illuminant D65.
XYZ = (
    (10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794),
    (2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897),
    (1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382),
)
# Here XYZ is relative to that of white, which has the sums of the rows.
TO_XYZ = [[entry / sum(row) for entry in row] for row in XYZ]
TO_RGB = torch.linalg.inv(torch.tensor(TO_XYZ, dtype=torch.float64)).tolist()
LINEAR_BELOW = (6 / 29) ** 3  # of XYZ; the cube root of CIELAB begins there
# The eye's sensitivity to luminance, red-green and blue-yellow (eq. 1 and table 1): sums of
# Gaussians a sqrt(pi / b) exp(-pi² x² / b), with x in degrees.
SENSITIVITY = (((1.0, 0.0047),), ((1.0, 0.0053),), ((34.1, 0.04), (13.5, 0.025)))
COLOR_POWER, FEATURE_POWER = 0.7, 0.5
# Color differences up to this share of the largest become errors up to the second number.
KNEE, ERROR_AT_KNEE = 0.4, 0.95
FEATURE_WIDTH = 0.082  # degrees, of edges and points that the eye detects


def flip(image: Tensor, target: Tensor, ppd: float = FLIP_PPD) -> Tensor:
    """Mean FLIP error of sRGB images: 0 identical, 1 worst.

    The viewer sees ``ppd`` pixels per degree.
    """
    return in_double_precision(flip_map(image, target, ppd)).mean(dim=(-2, -1))


def flip_map(image: Tensor, target: Tensor, ppd: float = FLIP_PPD) -> Tensor:
    """The FLIP error of every pixel, [H, W] or [B, H, W]; see `flip`."""
    check_pair(image, target)
    both = torch.cat([as_batch(image), as_batch(target)]).clamp(0, 1)  # [2B, 3, H, W]
    linear = torch.where(both <= 0.04045, both / 12.92, ((both + 0.055) / 1.055) ** 2.4)
    xyz = _mix(linear, TO_XYZ)
    color, feature = _color_difference(xyz, ppd), _feature_difference(xyz[:, 1:2], ppd)
    errors = color ** (1 - feature)  # [B, 1, H, W], eq. 9
    return errors[0, 0] if image.ndim == 3 else errors[:, 0]


def _mix(images: Tensor, rows: Sequence[Sequence[float]]) -> Tensor:
    """The colours of [B, 3, H, W] times a matrix."""
    red, green, blue = images.split(1, dim=1)
    return torch.cat([red * row[0] + green * row[1] + blue * row[2] for row in rows], dim=1)


def _filter(images: Tensor, horizontal: Sequence[float], vertical: Sequence[float]) -> Tensor:
    """Filter [B, C, H, W] along both axes; pixels of the border are repeated."""
    radius = len(horizontal) // 2
    padded = F.pad(images, [radius] * 4, mode="replicate")
    return correlate(correlate(padded, horizontal, 3), vertical, 2)


def _color_difference(xyz: Tensor, ppd: float) -> Tensor:
    """The difference of colours [B, 1, H, W], from 0 to 1, of images and targets [2B, 3, H, W]."""
    x, y, z = xyz.split(1, dim=1)
    opponents = y, x - y, y - z  # luminance, red-green, blue-yellow
    widest = max(b for terms in SENSITIVITY for _, b in terms)
    radius = math.ceil(3 * math.sqrt(widest / (2 * math.pi**2)) * ppd)  # px
    seen = []
    for opponent, terms in zip(opponents, SENSITIVITY, strict=True):
        filters = [_gaussian(a, b, radius, ppd) for a, b in terms]
        total = sum(sum(one) ** 2 for one in filters)
        scaled = [[weight / math.sqrt(total) for weight in one] for one in filters]
        seen.append(torch.stack([_filter(opponent, one, one) for one in scaled]).sum(dim=0))
    y, red_green, blue_yellow = seen
    rgb = _mix(torch.cat([y + red_green, y, y - blue_yellow], dim=1), TO_RGB).clamp(0, 1)
    difference = _distance(_hunt_lab(_mix(rgb, TO_XYZ)))
    purest = torch.eye(3, dtype=torch.float64)[1:, :, None, None]  # green and blue: the largest
    largest = float(_distance(_hunt_lab(_mix(purest, TO_XYZ))))
    knee = KNEE * largest
    beyond = ERROR_AT_KNEE + (1 - ERROR_AT_KNEE) / (largest - knee) * (difference - knee)
    return torch.where(difference < knee, difference * (ERROR_AT_KNEE / knee), beyond)


def _gaussian(a: float, b: float, radius: int, ppd: float) -> list[float]:
    """One axis of a separable Gaussian of `SENSITIVITY`, sampled at pixels."""
    height = math.sqrt(a * math.sqrt(math.pi / b))
    return [height * math.exp(-((math.pi * k / ppd) ** 2) / b) for k in range(-radius, radius + 1)]


def _hunt_lab(xyz: Tensor) -> Tensor:
    """CIELAB of [B, 3, H, W], whose colours count less where it is dark (the effect of Hunt)."""
    slope = LINEAR_BELOW ** (-2 / 3) / 3
    root = torch.where(
        xyz > LINEAR_BELOW, xyz.clamp_min(LINEAR_BELOW) ** (1 / 3), slope * xyz + 4 / 29
    )
    x, y, z = root.split(1, dim=1)
    lightness = 116 * y - 16
    return torch.cat([lightness, 5 * lightness * (x - y), 2 * lightness * (y - z)], dim=1)


def _distance(lab: Tensor) -> Tensor:
    """The distance HyAB [B, 1, H, W] of images from targets [2B, 3, H, W], to a power."""
    first, second = lab.chunk(2)
    lightness, a, b = (first - second).split(1, dim=1)
    return (lightness.abs() + torch.hypot(a, b)) ** COLOR_POWER


def _feature_difference(luminance: Tensor, ppd: float) -> Tensor:
    """The difference of edges and points [B, 1, H, W], from 0 to 1, of Y [2B, 1, H, W]."""
    sigma = 0.5 * FEATURE_WIDTH * ppd  # px
    radius = math.ceil(3 * sigma)
    gaussian = {k: math.exp(-0.5 * (k / sigma) ** 2) for k in range(-radius, radius + 1)}
    smooth = [weight / sum(gaussian.values()) for weight in gaussian.values()]
    edge = [-k * weight for k, weight in gaussian.items()]
    point = [((k / sigma) ** 2 - 1) * weight for k, weight in gaussian.items()]
    differences = []
    for detector in (edge, point):
        # Positive weights sum to 1, negative ones to -1.
        up, down = (sum(abs(w) for w in detector if (w > 0) == sign) for sign in (True, False))
        weights = [weight / (up if weight > 0 else down) for weight in detector]
        strength = torch.hypot(
            _filter(luminance, weights, smooth), _filter(luminance, smooth, weights)
        )
        first, second = strength.chunk(2)
        differences.append((first - second).abs())
    return (torch.maximum(*differences) / math.sqrt(2)) ** FEATURE_POWER
