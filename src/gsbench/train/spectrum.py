"""Sizes at which pictures are trained on, from how much of their spectrum each size shows (DashGaussian)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Of the authors' code (utils/schedule_utils.py).
LARGEST_SCALE = 8.0  # pictures are never divided by more
FIRST_SHARE = 1 / 4  # of each picture's spectrum, that the first size shows at least
LEVELS = 32  # points of the schedule, equally far apart in what they show


@dataclass(frozen=True)
class Levels:
    """A schedule of sizes: at iteration ``begins[i]`` pictures are divided by ``scales[i]``, which falls to 1."""

    begins: tuple[int, ...]
    scales: tuple[float, ...]

    def at(self, step: int) -> int:
        """The whole number by which iteration ``step`` divides pictures: between levels their area, in pixels, grows
        linearly."""
        area = np.interp(step, self.begins, [scale**-2 for scale in self.scales])
        return int(area**-0.5 + 1e-9)

    @property
    def full_from(self) -> int:
        """The iteration from which pictures are divided by less than two."""
        first = next(i for i, scale in enumerate(self.scales) if scale < 2)
        return self.begins[max(first - 1, 0)]


def levels(images: Sequence[NDArray[np.uint8]], until: int) -> Levels:
    """The levels at which ``images`` [H, W, 3] are trained on, from iteration 0 to ``until`` (arXiv 2503.18402).

    What a size shows of a picture is the sum of the moduli of its Fourier transform over the central window of that
    size. The first size shows a quarter of every picture, or divides by 8; the levels are equally far apart in what
    they show of the mean picture; and each begins when the logarithm of that, from the first to the whole, is as far on
    its way as the iteration is.
    """
    fractions = _fractions({image.shape[:2] for image in images})
    curves = np.stack([_shown(image, fractions) for image in images])  # [V, F]
    if not (curves[:, -1] > 0).all():  # a black picture shows nothing at any size
        return Levels((0,), (1.0,))
    largest = min(LARGEST_SCALE, *(1 / _least(fractions, curve, FIRST_SHARE * curve[-1]) for curve in curves))
    mean = curves.mean(0)
    first, whole = float(mean[fractions <= 1 / largest + 1e-12][-1]), float(mean[-1])
    shown = np.linspace(first, whole, LEVELS)
    scales = [largest, *(1 / _least(fractions, mean, share) for share in shown[1:-1]), 1.0]
    begins = [int(until * math.log(share / first) / math.log(whole / first)) if whole > first else 0 for share in shown]
    begins[-1] = until
    kept = [i for i in range(LEVELS) if i == LEVELS - 1 or begins[i] < begins[i + 1]]  # the last of those that coincide
    return Levels(tuple(begins[i] for i in kept), tuple(float(scales[i]) for i in kept))


def _fractions(shapes: set[tuple[int, ...]]) -> NDArray[np.float64]:
    """The sizes [F], as fractions from 0 to 1, at which a window over a spectrum of one of the ``shapes`` grows."""
    return np.unique([0.0, 1.0, *(2 * k / side for shape in shapes for side in shape for k in range(side // 2 + 1))])


def _shown(image: NDArray[np.uint8], fractions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share that windows of the sizes ``fractions`` [F] show of an image, [F]; the last is the whole spectrum."""
    spectrum = np.fft.fftshift(np.abs(np.fft.fft2(image / 255.0, axes=(0, 1))), axes=(0, 1)).sum(-1)  # [H, W]
    height, width = spectrum.shape
    sums = np.zeros((height + 1, width + 1))
    sums[1:, 1:] = spectrum.cumsum(0).cumsum(1)
    row, column = height // 2, width // 2  # of the mean
    tall, wide = ((side * fractions / 2 + 1e-9).astype(int) for side in (height, width))  # half windows [F]
    top, bottom, left, right = row - tall, row + tall, column - wide, column + wide
    shown = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    shown[-1] = sums[-1, -1]
    return shown


def _least(fractions: NDArray[np.float64], curve: NDArray[np.float64], share: float) -> float:
    """The least of ``fractions`` at which a rising ``curve`` [F] reaches ``share``."""
    return float(fractions[np.argmax(curve >= share * (1 - 1e-12))])
