"""Records of a training: losses, histograms of volumes, and lines of its JSON-lines files."""

import json
import math
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from torch import Tensor

from gsbench.densify.volumetric import log_volume
from gsbench.files import write_text
from gsbench.raster.staged import Readback
from gsbench.runs.trial_record import whole_lines

PHOTOMETRIC = ("loss", "l1", "ssim")  # what the built-in loss gives
SMOOTHING = 0.9  # weight of the previous mean in the smoothed loss
LOG_VOLUME_BINS = np.linspace(-18, 3, 85)  # log10 of world units^3, in steps of 0.25


class LossLog:
    """The losses of a training, in order of iterations. Losses from a GPU arrive with a delay.

    ``smoothed`` is the exponential mean of the losses that have arrived; NaN before the first.
    """

    def __init__(self, names: Sequence[str] = PHOTOMETRIC) -> None:
        self.names = tuple(names)
        self.smoothed = math.nan
        self._pending: deque[tuple[int, Readback]] = deque()
        self._latest: dict[str, float] = {}

    def add(self, step: int, scalars: Tensor) -> None:
        """Add the ``scalars`` of iteration ``step``, in the order of ``names``.

        One number more is the total with the densifier's regulariser. Raises FloatingPointError if
        one that has arrived by now is not finite.
        """
        self._pending.append((step, Readback(scalars)))
        while self._pending and self._pending[0][1].arrived:
            self._take()

    def wait(self) -> dict[str, float]:
        """Wait for all losses; return ``step`` and those of the last iteration by name.

        Raises FloatingPointError, which names the first iteration whose total was not finite.
        """
        while self._pending:
            self._take()
        return self._latest

    def _take(self) -> None:
        step, readback = self._pending.popleft()
        values = readback.values().tolist()
        for name, value in zip((*self.names, "loss"), values, strict=False):
            # L1 and SSIM are only shown: a loss that counts is finite, or the training ends.
            if not math.isfinite(value) and name not in ("l1", "ssim"):
                raise FloatingPointError(f"the {name} became {value} at iteration {step}")
        loss = values[0]
        is_first = math.isnan(self.smoothed)
        mean = SMOOTHING * self.smoothed + (1 - SMOOTHING) * loss
        self.smoothed = loss if is_first else mean
        self._latest = {"step": step, **dict(zip(self.names, values, strict=False))}


def volume_histogram(step: int, log_scales: Tensor) -> dict[str, Any]:
    """The record of iteration ``step`` with a histogram of volumes, from ``log_scales`` [N, 3]."""
    volumes = (log_volume(log_scales) / math.log(10)).cpu().numpy()
    clipped = np.clip(volumes, LOG_VOLUME_BINS[0], LOG_VOLUME_BINS[-1])
    counts, edges = np.histogram(clipped, LOG_VOLUME_BINS)
    return {"step": step, "log10_edges": edges.tolist(), "counts": counts.tolist()}


def append(stream: TextIO, record: dict[str, Any]) -> None:
    """Append a record to an open file, and flush it so that readers see it."""
    stream.write(json.dumps(record) + "\n")
    stream.flush()


def drop_after(path: Path, step: int) -> None:
    """Remove records later than ``step`` from a JSON-lines file, if it exists.

    An incomplete last line is removed, too. A resumed training writes the removed records again. A
    kill leaves the old or the new file, never a part of one.
    """
    if path.exists():
        write_text(path, "".join(f"{line}\n" for line, at in whole_lines(path) if at <= step))
