"""Volumes of trained Gaussians, from the point clouds of trials."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.results import TrialResult
from gsbench.errors import InputError
from gsbench.runs.layout import POINT_CLOUD

LOG10_SPHERE = math.log10(4 / 3 * math.pi)
BIN_WIDTH = 0.25  # decades


def log10_volumes(path: Path) -> NDArray[np.float64]:
    """log10 of the volumes ``4/3 π s1 s2 s3`` [N] of a 3DGS PLY, whose scales are natural logarithms."""
    logs = np.sum(_columns(path, ("scale_0", "scale_1", "scale_2")), axis=0)
    return LOG10_SPHERE + logs / math.log(10)


def _columns(path: Path, names: Sequence[str]) -> list[NDArray[np.float64]]:
    """The values [N] of these properties of the Gaussians of a 3DGS PLY; raises `InputError`."""
    from plyfile import PlyData, PlyParseError  # here, since only reports read point clouds

    try:
        vertices = PlyData.read(path)["vertex"]
        return [np.asarray(vertices[name], dtype=np.float64) for name in names]
    except (OSError, ValueError, KeyError, PlyParseError) as error:
        raise InputError(f"{path} is not a readable 3DGS PLY ({error})") from None


def volume_histogram(trials: Sequence[TrialResult]) -> list[tuple[float, float]]:
    """(volume, share of Gaussians) of the trials' pooled Gaussians, in bins of a quarter decade; only filled bins."""
    volumes = np.concatenate([log10_volumes(trial.path / POINT_CLOUD) for trial in trials])
    volumes = volumes[np.isfinite(volumes)]
    bins, counts = np.unique(np.floor(volumes / BIN_WIDTH), return_counts=True)
    return [
        (10 ** ((k + 0.5) * BIN_WIDTH), n / len(volumes)) for k, n in zip(bins.tolist(), counts.tolist(), strict=True)
    ]


def share_above(trials: Sequence[TrialResult], threshold: float) -> float:
    """The share of the trials' pooled Gaussians whose volume exceeds ``threshold``."""
    volumes = np.concatenate([log10_volumes(trial.path / POINT_CLOUD) for trial in trials])
    return float(np.mean(volumes > math.log10(threshold)))
