"""Quality against cost: the curves of two arms, and the area between them as one number."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.cells import by_key
from gsbench.analysis.quantities import Quantity
from gsbench.analysis.results import TrialResult

GRID = 200  # points at which two curves are compared

Array = NDArray[np.float64]
COST_READERS: dict[str, Callable[[TrialResult], float | None]] = {
    "gaussians": lambda trial: trial.record.num_gaussians,
    "seconds": lambda trial: trial.record.seconds.get("train"),
}


@dataclass(frozen=True)
class Curve:
    """Quality [n] at increasing positive cost [n]; ``labels`` names the points."""

    cost: Array
    quality: Array
    labels: tuple[str, ...]


@dataclass(frozen=True)
class CurveGap:
    """Mean quality of the second curve minus the first at equal cost, over the costs that both cover (log scale)."""

    gap: float
    low: float
    high: float


def family_curve(trials: Sequence[TrialResult], family: tuple[str, str], quality: Quantity, cost: str) -> Curve:
    """One point for each variant of a densifier (init, densify): means over seeds, then over scenes."""
    read = COST_READERS[cost]
    own = [trial for trial in trials if (trial.init, trial.densify) == family]
    points = []
    for variant, group in by_key(own, lambda trial: str(trial.arm)).items():
        cost_mean = _mean_of_scenes(group, read)
        quality_mean = _mean_of_scenes(group, quality.read)
        if cost_mean and quality_mean is not None:
            points.append((cost_mean, quality_mean, variant))
    return _curve(points)


def training_curve(trials: Sequence[TrialResult], cost: str, quality: str) -> Curve:
    """Quality during training against Gaussians or seconds, averaged over trials step by step (``metrics.jsonl``)."""
    key = {"gaussians": "num_gaussians", "seconds": "seconds"}[cost]
    by_step: dict[int, list[tuple[float, float]]] = {}
    for trial in trials:
        for row in trial.folder.curves():
            if key in row and quality in row:
                by_step.setdefault(int(row["step"]), []).append((row[key], row[quality]))
    full = {step: rows for step, rows in by_step.items() if len(rows) == len(trials)}
    points = [
        (statistics.fmean(row[0] for row in rows), statistics.fmean(row[1] for row in rows), str(step))
        for step, rows in sorted(full.items())
    ]
    return _curve([point for point in points if point[0] > 0])


def curve_gap(first: Curve, second: Curve) -> CurveGap | None:
    """The area between two curves divided by its width, with cost on a log scale.

    The idea of Bjøntegaard (VCEG-M33, 2001) with monotone cubic interpolation instead of one polynomial. None where a
    curve has fewer than two points or the curves share no cost: nothing is extrapolated.
    """
    from scipy.interpolate import PchipInterpolator  # here, since it is slow to import

    if min(len(first.cost), len(second.cost)) < 2:
        return None
    low = max(first.cost[0], second.cost[0])
    high = min(first.cost[-1], second.cost[-1])
    if low >= high:
        return None
    grid = np.linspace(math.log(low), math.log(high), GRID)
    one, other = (PchipInterpolator(np.log(curve.cost), curve.quality)(grid) for curve in (first, second))
    area = np.trapezoid(other - one, grid)
    return CurveGap(float(area / (grid[-1] - grid[0])), float(low), float(high))


def _mean_of_scenes(group: Sequence[TrialResult], read: Callable[[TrialResult], float | None]) -> float | None:
    means = []
    for trials in by_key(group, lambda trial: trial.scene).values():
        values = [value for value in map(read, trials) if value is not None]
        if not values:
            return None
        means.append(statistics.fmean(values))
    return statistics.fmean(means)


def _curve(points: Sequence[tuple[float, float, str]]) -> Curve:
    """Points sorted by cost; those of equal cost are averaged, since a curve has one value there."""
    merged: dict[float, list[tuple[float, str]]] = {}
    for cost, quality, label in sorted(points):
        merged.setdefault(cost, []).append((quality, label))
    return Curve(
        np.array(list(merged)),
        np.array([statistics.fmean(quality for quality, _ in found) for found in merged.values()]),
        tuple("/".join(label for _, label in found) for found in merged.values()),
    )
