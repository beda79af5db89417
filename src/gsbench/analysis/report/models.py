"""Trained models in the report: the volumes of their Gaussians, and how far two trainings of one arm lie apart.

Two seeds may reach one PSNR by different models. One training is compared with another, not with photographs.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.cells import by_key
from gsbench.analysis.differences import differing_conditions
from gsbench.analysis.errors_by_region import read_image, view_names
from gsbench.analysis.results import Arm, TrialResult
from gsbench.errors import InputError
from gsbench.runs.layout import POINT_CLOUD, RENDERS

PAIRS = 3  # of neighbouring seeds, at most, for each scene and arm
VIEWS = 8  # that are compared of a pair, at most, evenly spread
POINTS = 50_000  # whose nearest partner is looked for, at most, evenly spread over the file
PSNR_CAP = 100.0  # dB, of identical pictures, as the protocols have it
MIN_OPACITY = 0.1  # fainter Gaussians may lie anywhere and are left out
FAR = 0.95  # the share of points that lies nearer than the distance called far

T = TypeVar("T")
Reader = Callable[[Path], NDArray[np.float64]]


@dataclass(frozen=True)
class CloudDistance:
    """Distances between two point sets, in world units: from each point to the nearest of the other set."""

    mean: float  # of the two sets' means: half of what is often called the Chamfer distance
    far: float  # 95 % of the points of both lie nearer


@dataclass(frozen=True)
class Agreement:
    """One arm on one scene, as means over ``pairs`` of trainings with neighbouring seeds; None where not at hand.

    ``psnr`` is that of one training's renders against the other's, dB; ``distance`` and ``far`` are shares of the
    scene's extent; ``faults`` say what could not be read.
    """

    scene: str
    arm: Arm
    pairs: int
    psnr: float | None
    distance: float | None
    far: float | None
    faults: tuple[str, ...]


def agreements(trials: Sequence[TrialResult]) -> list[Agreement]:
    """The agreement of each scene and arm with at least two seeds under one set of conditions, sorted by name."""
    found = []
    read = cache(read_positions)  # a training stands in two pairs
    for (scene, arm), group in sorted(by_key(trials, lambda trial: (trial.scene, trial.arm)).items()):
        in_order = sorted(group, key=lambda trial: trial.seed)
        pairs = [pair for pair in pairwise(in_order) if not differing_conditions(pair)][:PAIRS]
        if pairs:
            found.append(_agreement(scene, arm, pairs, read))
        read.cache_clear()
    return found


def render_psnr(first: TrialResult, second: TrialResult) -> float:
    """The mean over test views of the PSNR of one trial's renders against the other's, dB; the same either way round.

    Raises `InputError` where renders are missing, damaged, or of other views or sizes.
    """
    names = view_names(first)
    if names != view_names(second):
        raise InputError(f"{first.label} and {second.label} have different renders")
    chosen = [names[index] for index in _spread(len(names), VIEWS)]
    return statistics.fmean(
        image_psnr(*(read_image(trial.path / RENDERS / f"{name}.png") for trial in (first, second))) for name in chosen
    )


def image_psnr(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> float:
    """PSNR in dB of two 8-bit images [H, W, 3], at most 100; raises `InputError` for unequal sizes."""
    if first.shape != second.shape:
        raise InputError(f"renders are {first.shape[1]}x{first.shape[0]} and {second.shape[1]}x{second.shape[0]} px")
    error = float(np.mean((first.astype(np.float64) - second) ** 2))
    return PSNR_CAP if error == 0 else min(PSNR_CAP, 10 * float(np.log10(255**2 / error)))


def cloud_distance(first: NDArray[np.float64], second: NDArray[np.float64]) -> CloudDistance:
    """Measure the distance between the points [N, 3] and [M, 3]; raises `InputError` where a set is empty."""
    from scipy.spatial import cKDTree  # here, since only reports need it

    if not (len(first) and len(second)):
        raise InputError("a training has no visible Gaussians")
    ways = [
        cKDTree(there).query(here[_spread(len(here), POINTS)])[0] for here, there in ((first, second), (second, first))
    ]
    return CloudDistance(float(np.mean([way.mean() for way in ways])), float(np.quantile(np.concatenate(ways), FAR)))


def read_positions(path: Path) -> NDArray[np.float64]:
    """The centres [N, 3] of the Gaussians of a 3DGS PLY whose opacity is at least 0.1; raises `InputError`."""
    *places, logits = _columns(path, ("x", "y", "z", "opacity"))
    points = np.stack(places, axis=1)  # [N, 3]
    return points[(logits >= np.log(MIN_OPACITY / (1 - MIN_OPACITY))) & np.isfinite(points).all(axis=1)]


def _agreement(scene: str, arm: Arm, pairs: Sequence[tuple[TrialResult, TrialResult]], read: Reader) -> Agreement:
    faults: list[str] = []
    psnrs = list(_measured(pairs, render_psnr, faults))

    def apart(first: TrialResult, second: TrialResult) -> tuple[float, float]:
        distance = cloud_distance(*(read(trial.path / POINT_CLOUD) for trial in (first, second)))
        return distance.mean / _extent(first), distance.far / _extent(first)

    distances = list(_measured(pairs, apart, faults))
    means, fars = [mean for mean, _ in distances], [far for _, far in distances]
    return Agreement(scene, arm, len(pairs), _mean(psnrs), _mean(means), _mean(fars), tuple(dict.fromkeys(faults)))


def _extent(trial: TrialResult) -> float:
    if not trial.record.scene_extent:
        raise InputError(f"{trial.label} does not say how large its scene is")
    return trial.record.scene_extent


def _mean(values: Sequence[float]) -> float | None:
    return statistics.fmean(values) if values else None


def _measured(
    pairs: Sequence[tuple[TrialResult, TrialResult]],
    measure: Callable[[TrialResult, TrialResult], T],
    faults: list[str],
) -> Iterator[T]:
    """Measurements of the pairs; the reasons why some cannot be measured go to ``faults``."""
    for pair in pairs:
        try:
            yield measure(*pair)
        except InputError as error:
            faults.append(str(error))


def _spread(count: int, at_most: int) -> NDArray[np.int64]:
    """Indices of at most ``at_most`` of ``count`` things, evenly spread, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, at_most)).round().astype(np.int64))


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
