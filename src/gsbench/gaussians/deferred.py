"""Adam for harmonics that steps a Gaussian when it is looked at: the same numbers for less memory traffic.

A view sees some of the Gaussians, and harmonics are 45 of a Gaussian's 59 numbers. Where a Gaussian is not seen its
harmonics have no gradient, and dense Adam (Kingma and Ba 2015) only lets them coast on their moments m and v. Then k
such steps after step t have the closed form, as long as eps is nothing beside sqrt(v):

    value -= m / sqrt(v) * sum over j = 1..k of rate_s (beta1 / sqrt(beta2))^j sqrt(1 - beta2^s) / (1 - beta1^s),
    m *= beta1^k,  v *= beta2^k,   with s = t + j; where v is 0 nothing moves.

The sum depends on t and k alone, so one small table serves all Gaussians (`Coasting`). Whoever reads harmonics makes
up for the missed steps: a rasterizer on the way into its registers, the next step of a Gaussian, and `settle` for all.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

BETA1, BETA2 = 0.9, 0.999  # 3DGS, and torch's defaults
HORIZON = 256  # steps; (beta1 / sqrt(beta2))^256 = 2e-12 is nothing beside the first term
FIRST_CAPACITY = 1024  # steps


class Coasting:
    """Distance that a Gaussian has coasted that was last stepped at step t, for every t up to the present ``step``."""

    def __init__(self, step: int = 0, drift: Tensor | None = None) -> None:
        self.step = step
        self._exact = np.zeros(FIRST_CAPACITY)  # [capacity] float64; place t: the sum over j so far
        self.drift: NDArray[np.float32] = np.zeros(FIRST_CAPACITY, np.float32)  # [capacity] the same for the kernels
        self.first_decay, self.second_decay = _powers(FIRST_CAPACITY)  # [capacity] place k: beta^k
        self._reserve(step)
        if drift is not None:
            self._exact[: step + 1] = drift.numpy()
            self.drift[: step + 1] = self._exact[: step + 1]

    def advance(self, rate: float) -> None:
        """Count a step at the learning rate ``rate``."""
        self.step += 1
        self._reserve(self.step)
        factor = rate * np.sqrt(1 - BETA2**self.step) / (1 - BETA1**self.step)
        first = max(0, self.step - HORIZON)
        missed = np.arange(self.step - first, 0, -1)
        self._exact[first : self.step] += factor * (BETA1 / np.sqrt(BETA2)) ** missed
        self.drift[first : self.step] = self._exact[first : self.step]

    def saved(self) -> Tensor:
        """The table, [step + 1] float64; with ``step`` it makes the same object again."""
        return torch.from_numpy(self._exact[: self.step + 1].copy())

    def _reserve(self, step: int) -> None:
        capacity = len(self._exact)
        if step < capacity:
            return
        grown = max(2 * capacity, step + 1)
        self._exact = np.concatenate([self._exact, np.zeros(grown - capacity)])
        self.drift = self._exact.astype(np.float32)
        self.first_decay, self.second_decay = _powers(grown)


def _powers(count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    exponents = np.arange(count)
    return (BETA1**exponents).astype(np.float32), (BETA2**exponents).astype(np.float32)


class HarmonicsGradient(Protocol):
    """The gradient of harmonics as a backward pass leaves it: for each Gaussian seen, basis times colour gradient."""

    def dense(self) -> Tensor:
        """The gradient of every Gaussian, [N, 15, 3]."""
        ...

    def step(self, harmonics: DeferredHarmonics, rate: float, epsilon: float) -> None:
        """Make the step after ``harmonics.coasting.step`` for the Gaussians seen, with what they have missed."""
        ...


@dataclass
class DeferredHarmonics:
    """``sh_rest`` with its moments, each Gaussian of which may be some steps behind; all tensors are changed in place.

    Belongs to a `TrainableGaussians`, which hands it to a rasterizer that can (`raster.base.DeferringRasterizer`).
    """

    values: Tensor  # [N, 15, 3]
    first: Tensor  # [N, 15, 3] exp_avg
    second: Tensor  # [N, 15, 3] exp_avg_sq
    last: Tensor  # [N] int32: the step up to which each Gaussian has come
    coasting: Coasting = field(default_factory=Coasting)
    gradient: HarmonicsGradient | None = None  # of the present iteration

    def receive(self, gradient: HarmonicsGradient) -> None:
        """Take the gradient of a backward pass; that of an earlier one, not yet stepped with, is added."""
        self.flatten_gradient()
        self.gradient = gradient

    def flatten_gradient(self) -> None:
        """Add ``gradient`` to that of ``values``, as autograd would have left it."""
        if self.gradient is not None:
            dense = self.gradient.dense()
            self.values.grad = dense if self.values.grad is None else self.values.grad + dense
            self.gradient = None

    def settled(self) -> tuple[Tensor, Tensor, Tensor]:
        """Copies of the values and both moments with all missed steps made."""
        last = self.last.long()
        missed = self.coasting.step - last  # [N]

        def column(table: NDArray[np.float32], place: Tensor) -> Tensor:
            return torch.from_numpy(table).to(place.device)[place].reshape(-1, 1, 1)

        direction = torch.where(self.second > 0, self.first / self.second.sqrt(), 0.0)
        return (
            self.values.detach() - direction * column(self.coasting.drift, last),
            self.first * column(self.coasting.first_decay, missed),
            self.second * column(self.coasting.second_decay, missed),
        )

    @torch.no_grad()
    def settle(self) -> None:
        """Make all missed steps."""
        if bool((self.last < self.coasting.step).any()):
            for tensor, settled in zip((self.values, self.first, self.second), self.settled(), strict=True):
                tensor.copy_(settled)
            self.last.fill_(self.coasting.step)
