"""Functions that several densifiers share: draws, opacities, quantiles."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def standard_normal(shape: tuple[int, ...], rng: torch.Generator, like: Tensor) -> Tensor:
    """Draw normal numbers with the dtype and the device of ``like``.

    ``rng`` is a CPU generator. For another device, it seeds a temporary generator there, which
    draws the numbers. So no numbers are uploaded, and a checkpoint must save only the state of
    ``rng``. The same seed gives other numbers there than on the CPU.
    """
    if like.device.type == "cpu":
        return torch.randn(shape, generator=rng, dtype=like.dtype)
    seed = int(torch.randint(2**62, (1,), generator=rng))
    device_rng = torch.Generator(like.device).manual_seed(seed)
    return torch.randn(shape, generator=device_rng, dtype=like.dtype, device=like.device)


MIN_REVISED_OPACITY = 1e-6  # keeps the logit finite


def revised_logits(opacity_logits: Tensor) -> Tensor:
    """The logits of 1 - sqrt(1 - o) for opacities o (Revising Densification, arXiv 2404.06109).

    Two Gaussians of this opacity, one behind the other, are as opaque as one of opacity o.
    """
    transmittance = (-opacity_logits).sigmoid().sqrt()  # sqrt(1 - o)
    return torch.logit((1 - transmittance).clamp_min(MIN_REVISED_OPACITY))


def faded(opacity_logits: Tensor, factor: float) -> Tensor:
    """The logits of ``factor`` (at most 1) times the opacities."""
    return torch.logit(factor * opacity_logits.sigmoid())


def quantile(ordered: Tensor, q: float) -> float:
    """The ``q``-quantile of sorted values [N], interpolated linearly.

    Unlike torch.quantile, it accepts more than 16 M values.
    """
    position = q * (len(ordered) - 1)
    low = math.floor(position)
    high = min(low + 1, len(ordered) - 1)
    return float(ordered[low] + (position - low) * (ordered[high] - ordered[low]))
