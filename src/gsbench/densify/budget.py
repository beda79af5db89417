"""Limits on the number of Gaussians of an arm, shared by all densifiers."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from gsbench.errors import InputError

CapKind = Literal["soft", "freeze", "hard", "curve", "governor"]
SETTLE_STEPS = 40  # halvings of a range of the logarithm: far below the distance of neighbouring float32 scores


def check_room(most: int, num_initial: int) -> None:
    """Raise InputError where the initial cloud has more Gaussians than an arm may ever have."""
    if most < num_initial:
        raise InputError(
            f"densify.max_gaussians must be at least the size of the initial cloud ({num_initial}), got {most}"
        )


def limit_at(step: int, start: int, stop: int, initial: int, max_gaussians: int | None, cap: CapKind) -> int | None:
    """The cap that holds at iteration ``step``.

    ``curve`` rises from the ``initial`` count at ``start`` to ``max_gaussians`` at ``stop`` along n0 + (n - n0) (2x -
    x^2), so that arms grow alike and the last refinements are small (the idea of Taming 3DGS, arXiv 2406.15643).
    """
    if max_gaussians is None or cap != "curve":
        return max_gaussians
    x = min(max((step - start) / (stop - start), 0.0), 1.0)
    return round(initial + (max_gaussians - initial) * (2 * x - x * x))


def allowance(num_gaussians: int, max_gaussians: int | None, cap: CapKind) -> int | None:
    """The number of Gaussians that a growth step may add; None for no limit.

    ``soft``: no limit up to ``max_gaussians``, nothing beyond it, so one step may overshoot (the paper's cap, whose
    counts end at 3.41 to 3.57 M for 3.4 M). ``hard`` and ``curve``: never beyond it. ``freeze`` and ``governor`` set no
    limit within a round.
    """
    if max_gaussians is None or cap in ("freeze", "governor"):
        return None
    if cap == "soft":
        return None if num_gaussians <= max_gaussians else 0
    return max(0, max_gaussians - num_gaussians)


def admit(candidates: Tensor, score: Tensor, gain: int, allowed: int | None) -> tuple[Tensor, int]:
    """The candidates that the allowance admits, best ``score`` first (ties by index), and how many it refused.

    ``candidates`` is a mask [N], ``score`` [N]; each candidate adds ``gain`` Gaussians.
    """
    count = int(candidates.sum())
    if allowed is None or count * gain <= allowed:
        return candidates, 0
    places = allowed // gain if gain > 0 else count
    index = candidates.nonzero().squeeze(-1)  # [C]
    best = index[torch.sort(score[index], descending=True, stable=True).indices[:places]]
    admitted = torch.zeros_like(candidates)
    admitted[best] = True
    return admitted, count - places


def settle(count: Callable[[float], int], target: int, low: float, high: float) -> float:
    """The factor in [``low``, ``high``] at which ``count``, which falls with it, is nearest to ``target`` from below;
    ``high`` where it never falls so far."""
    if count(low) <= target:
        return low
    a, b = math.log(low), math.log(high)
    for _ in range(SETTLE_STEPS):
        middle = (a + b) / 2
        reached = count(math.exp(middle))
        if reached == target:
            return math.exp(middle)
        a, b = (middle, b) if reached > target else (a, middle)
    return min(high, math.exp(b))
