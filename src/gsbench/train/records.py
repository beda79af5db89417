"""Records of a training: losses, histograms of volumes, JSON lines, and warnings about growth."""

import json
import logging
import math
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from torch import Tensor

from gsbench.densify.volumetric import log_volume
from gsbench.events import RefineEvent
from gsbench.files import write_text
from gsbench.raster.staged import Readback
from gsbench.runs.trial_record import whole_lines

log = logging.getLogger(__name__)

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


# Of the Gaussians that a round splits by volume, the share whose children are still too voluminous.
RUNAWAY_SHARE = 0.5
# Rounds in a row. On bonsai the runaway of eq. 7 keeps such a share for 100 rounds and more.
RUNAWAY_ROUNDS = 10
FEW_SPLITS = 0.01  # of all Gaussians; a rule that splits fewer does not fill the memory
BLOCKED_ITERATIONS = 1000


class GrowthWatch:
    """Looks at the events of a training, and warns once about each kind of trouble."""

    def __init__(self) -> None:
        self._runaway_rounds = 0
        self._blocked_since: int | None = None
        self._warned: set[str] = set()

    def observe(self, event: RefineEvent) -> None:
        """Look at the next refinement."""
        self._watch_splits(event)
        self._watch_limit(event)

    def _watch_splits(self, event: RefineEvent) -> None:
        share = event.isotropic_resplit / max(event.split_volume, 1)
        many = event.split_volume >= FEW_SPLITS * event.before
        self._runaway_rounds = self._runaway_rounds + 1 if share >= RUNAWAY_SHARE and many else 0
        if self._runaway_rounds == RUNAWAY_ROUNDS:
            self._warn(
                "iteration %d: in %d refinements in a row, at least %.0f %% of splits by volume "
                "had children that are over the threshold again, so they split again and again; "
                "densify=volumetric_once does not split near-spheres",
                event.step,
                RUNAWAY_ROUNDS,
                100 * RUNAWAY_SHARE,
            )

    def _watch_limit(self, event: RefineEvent) -> None:
        if not event.grew_or_was_blocked:
            return
        if not event.blocked_by_cap:
            self._blocked_since = None
            return
        if self._blocked_since is None:
            self._blocked_since = event.step
        if event.step - self._blocked_since > BLOCKED_ITERATIONS:
            self._warn(
                "iterations %d to %d: densify.max_gaussians refused growth in every refinement, so "
                "the rule no longer decides where Gaussians are; raise it, or compare at equal "
                "counts with densify.cap=governor",
                self._blocked_since,
                event.step,
            )

    def _warn(self, message: str, *values: float) -> None:
        if message not in self._warned:
            self._warned.add(message)
            log.warning(message, *values)
