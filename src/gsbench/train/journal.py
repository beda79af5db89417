"""The journal of a training: loss curves, refinements and histograms of volumes as JSON lines, one file each."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from torch import Tensor

from gsbench.densify.volume import log_volume
from gsbench.files import write_text
from gsbench.runs.rows import whole_lines

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
