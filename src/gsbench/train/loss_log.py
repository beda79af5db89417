"""The losses of a training, read without making the host wait for the device at every iteration."""

from __future__ import annotations

import math
from collections import deque

import torch
from torch import Tensor

from gsbench.raster.readback import Readback

SMOOTHING = 0.9  # of the loss that is shown


class LossLog:
    """The losses of all iterations so far, in order: those of the latest may still be on their way from the device.

    On the CPU each is there at once. ``smoothed`` is their exponential mean, NaN before the first.
    """

    def __init__(self) -> None:
        self.smoothed = math.nan
        self._under_way: deque[tuple[int, Readback]] = deque()
        self._latest: dict[str, float] = {}

    def add(self, step: int, loss: Tensor, l1: Tensor, ssim: Tensor, total: Tensor) -> None:
        """Take the scalars of iteration ``step``; ``total`` is what is differentiated: the loss and a regulariser."""
        scalars = [scalar.detach().to(loss) for scalar in (loss, l1, ssim, total)]
        self._under_way.append((step, Readback(torch.stack(scalars))))
        while self._under_way and self._under_way[0][1].arrived:
            self._take()

    def settle(self) -> dict[str, float]:
        """Wait for all; the latest iteration's ``step``, ``loss``, ``l1`` and ``ssim``.

        Raises FloatingPointError, as `add` does, naming the first iteration whose total was not finite.
        """
        while self._under_way:
            self._take()
        return self._latest

    def _take(self) -> None:
        step, readback = self._under_way.popleft()
        loss, l1, ssim, total = readback.values().tolist()
        if not math.isfinite(total):
            raise FloatingPointError(f"the loss became {total} at iteration {step}")
        self.smoothed = loss if math.isnan(self.smoothed) else SMOOTHING * self.smoothed + (1 - SMOOTHING) * loss
        self._latest = {"step": step, "loss": loss, "l1": l1, "ssim": ssim}
