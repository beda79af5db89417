"""Colours of a render fitted to its photograph, so that exposure and white balance of a view do not count as errors."""

from __future__ import annotations

import torch
from torch import Tensor

from gsbench.eval.images import exact

LEAST_SLOPE = 0.01  # below it a channel has no contrast that a fit could use: only its mean is moved


def fit_colors(image: Tensor, target: Tensor, where: Tensor) -> Tensor:
    """``image`` [H, W, 3] after the affine map of each channel that brings it nearest to ``target``, in [0, 1].

    The map is fitted to the pixels ``where`` [H, W] is True: ``image = slope * target + offset`` by least squares, then
    inverted. Fitting in this direction keeps a blurred or noisy render from being drawn towards the mean, which would
    reward it. RawNeRF (Mildenhall et al. 2022, supplement) and gsplat's evaluation (``color_correct_affine``) do so.
    """
    known, seen = exact(target[where]), exact(image[where])  # [P, 3] each
    known_mean, seen_mean = known.mean(dim=0), seen.mean(dim=0)  # [3]
    variance = (known - known_mean).square().mean(dim=0)
    covariance = ((known - known_mean) * (seen - seen_mean)).mean(dim=0)
    slope = covariance / variance.clamp_min(torch.finfo(variance.dtype).tiny)
    slope = torch.where(slope.isfinite() & (slope > LEAST_SLOPE), slope, 1.0)
    return ((exact(image) - seen_mean) / slope + known_mean).clamp(0, 1).to(image.dtype)
