"""The journal of a training: its losses, read without making the device wait, and records as JSON lines."""

import json
import math
from collections import deque
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import torch
from torch import Tensor

from gsbench.densify.volumetric import log_volume
from gsbench.files import write_text
from gsbench.raster.staged import Readback
from gsbench.runs.trial_record import whole_lines

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


LOG_VOLUME_BINS = np.linspace(-18, 3, 85)  # log10 of world units^3, a quarter decade each


def volume_histogram(step: int, log_scales: Tensor) -> dict[str, Any]:
    """The record of iteration ``step`` on the volumes of Gaussians with ``log_scales`` [N, 3]: counts by bin."""
    volumes = (log_volume(log_scales) / math.log(10)).cpu().numpy()
    clipped = np.clip(volumes, LOG_VOLUME_BINS[0], LOG_VOLUME_BINS[-1])
    counts, edges = np.histogram(clipped, LOG_VOLUME_BINS)
    return {"step": step, "log10_edges": edges.tolist(), "counts": counts.tolist()}


def append(stream: TextIO, record: dict[str, Any]) -> None:
    """Add a record to an open file, where a reader finds it at once."""
    stream.write(json.dumps(record) + "\n")
    stream.flush()


def drop_after(path: Path, step: int) -> None:
    """Remove the records later than ``step``, and a torn last line, from a JSON-lines file, if it is there.

    A kill meanwhile leaves the file as it was: what is lost here is in no checkpoint.
    """
    if path.exists():
        write_text(path, "".join(f"{line}\n" for line, at in whole_lines(path) if at <= step))
