"""The volumes of trained Gaussians, read from the PLY files of trials."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.results import Trial
from gsbench.errors import InputError

POINT_CLOUD = "point_cloud.ply"
LOG10_SPHERE = math.log10(4 / 3 * math.pi)
BIN_WIDTH = 0.25  # decades
_TYPES = {"float": "<f4", "float32": "<f4", "double": "<f8", "uchar": "u1", "uint8": "u1", "int": "<i4", "uint": "<u4"}


def log10_volumes(path: Path) -> NDArray[np.float64]:
    """log10 of the volumes ``4/3 π s1 s2 s3`` [N] of a binary 3DGS PLY, whose scales are natural logarithms."""
    try:
        with path.open("rb") as file:
            count, dtype = _read_header(file)
            vertices = np.fromfile(file, dtype=dtype, count=count)
        if len(vertices) != count:
            raise ValueError(f"{len(vertices)} of {count} vertices")
        logs = sum(vertices[f"scale_{axis}"].astype(np.float64) for axis in range(3))
    except (OSError, ValueError, KeyError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not a readable 3DGS PLY ({error})") from None
    return LOG10_SPHERE + np.asarray(logs) / math.log(10)


def volume_histogram(trials: Sequence[Trial]) -> list[tuple[float, float]]:
    """(volume, share of Gaussians) of the trials' pooled Gaussians, in bins of a quarter decade; only filled bins."""
    volumes = np.concatenate([log10_volumes(trial.path / POINT_CLOUD) for trial in trials])
    volumes = volumes[np.isfinite(volumes)]
    bins, counts = np.unique(np.floor(volumes / BIN_WIDTH), return_counts=True)
    return [
        (10 ** ((k + 0.5) * BIN_WIDTH), n / len(volumes)) for k, n in zip(bins.tolist(), counts.tolist(), strict=True)
    ]


def share_above(trials: Sequence[Trial], threshold: float) -> float:
    """The share of the trials' pooled Gaussians whose volume exceeds ``threshold``."""
    volumes = np.concatenate([log10_volumes(trial.path / POINT_CLOUD) for trial in trials])
    return float(np.mean(volumes > math.log10(threshold)))


def _read_header(file: BinaryIO) -> tuple[int, np.dtype]:
    """(number of vertices, their record) of a little-endian PLY whose first element is the vertices."""
    if file.readline().strip() != b"ply" or b"binary_little_endian" not in file.readline():
        raise ValueError("not a little-endian binary PLY")
    count, fields = -1, []
    for line in file:
        words = line.decode("ascii").split()
        if words[:2] == ["element", "vertex"]:
            count = int(words[2])
        elif words[:1] == ["property"] and count >= 0:
            fields.append((words[2], _TYPES[words[1]]))
        elif words[:1] == ["end_header"]:
            return count, np.dtype(fields)
    raise ValueError("no end of its header")
