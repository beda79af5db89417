"""Functions that several densifiers share: random points, children, opacities and quantiles."""

import math

import torch
from torch import Tensor

from gsbench.gaussians.model import Gaussians

MIN_REVISED_OPACITY = 1e-6  # keeps the logit finite


def standard_normal(shape: tuple[int, ...], rng: torch.Generator, like: Tensor) -> Tensor:
    """Draw normal numbers of ``shape``, with the dtype and on the device of ``like``, determined by the CPU generator
    ``rng``.

    On another device, a temporary generator there draws the numbers, seeded by ``rng``. So no numbers are uploaded, and
    the state of ``rng`` is all that a checkpoint must save. The same seed gives other numbers there than on the CPU.
    """
    if like.device.type == "cpu":
        return torch.randn(shape, generator=rng, dtype=like.dtype)
    seed = int(torch.randint(2**62, (1,), generator=rng))
    device_rng = torch.Generator(like.device).manual_seed(seed)
    return torch.randn(shape, generator=device_rng, dtype=like.dtype, device=like.device)


def sample_inside(gaussians: Gaussians, rng: torch.Generator) -> Tensor:
    """Draw one point from the density of each Gaussian: mu + R e with e ~ N(0, diag(s^2)), [N, 3]."""
    noise = standard_normal((len(gaussians), 3), rng, gaussians.means)  # [N, 3]
    offsets = noise * gaussians.scales  # [N, 3] in the axes of each ellipsoid
    return gaussians.means + (gaussians.rotations @ offsets.unsqueeze(-1)).squeeze(-1)


def split(
    parents: Gaussians, children: int, child_log_scales: Tensor, rng: torch.Generator, sampled: bool = True
) -> Gaussians:
    """Return ``children`` new Gaussians per parent, [children * N]: all parents in order, repeated ``children`` times.

    Scales are ``child_log_scales`` [N, 3], the same for all children of a parent. Means are drawn from the parent's
    density, or equal its mean (``sampled=False``). Other properties are copied.
    """
    repeated = Gaussians.concatenate([parents] * children)
    means = sample_inside(repeated, rng) if sampled else repeated.means.clone()
    tensors = repeated.tensors() | {"means": means, "log_scales": child_log_scales.repeat(children, 1)}
    return Gaussians(**tensors)


def revised_logits(opacity_logits: Tensor) -> Tensor:
    """Logits of 1 - sqrt(1 - o): two such children, one behind the other, are as opaque as the parent.

    From Revising Densification (arXiv 2404.06109).
    """
    transmittance = (-opacity_logits).sigmoid().sqrt()  # sqrt(1 - o)
    return torch.logit((1 - transmittance).clamp_min(MIN_REVISED_OPACITY))


def quantile(ordered: Tensor, q: float) -> float:
    """The ``q``-quantile of sorted values [N], interpolated linearly (torch.quantile refuses more than 16 M values)."""
    position = q * (len(ordered) - 1)
    low = math.floor(position)
    high = min(low + 1, len(ordered) - 1)
    return float(ordered[low] + (position - low) * (ordered[high] - ordered[low]))


def faded(opacity_logits: Tensor, factor: float) -> Tensor:
    """Logits of ``factor`` (at most 1) times the opacity."""
    return torch.logit(factor * opacity_logits.sigmoid())
