"""The volumes of Gaussians in the report: final ones, and those logged during training."""

import itertools
import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.report.charts import line_chart
from gsbench.analysis.report.curves import Curve
from gsbench.analysis.results import Arm, TrialResult, group_by, trials_of
from gsbench.errors import InputError
from gsbench.runs import layout
from gsbench.runs.rows import Histogram

VOLUME_AXES = ("volume (cubed scene units)", "share")
LOG10_SPHERE = math.log10(4 / 3 * math.pi)
BIN_WIDTH = 0.25  # decades of volume


def volume_charts(
    trials: Sequence[TrialResult], arms: Sequence[Arm]
) -> tuple[list[str], list[str]]:
    """(charts, notes): histograms of volumes, for final models and logged iterations."""
    threshold = _threshold(trials)
    final: list[tuple[str, Curve]] = []
    notes = []
    for arm in arms:
        try:
            volumes = np.concatenate([*map(_volumes_in_training, trials_of(trials, arm))])
        except InputError as error:
            notes.append(f"{arm}: no histogram, {error}")
            continue
        final.append((str(arm), histogram(volumes)))
        if threshold:
            notes.append(
                f"{arm}: {np.mean(volumes > math.log10(threshold)):.2%} of volumes exceed "
                f"{threshold:g}."
            )
    lines = {"Volumes of the trained Gaussians": final}
    for arm in arms:
        histograms = _logged_histograms(trials_of(trials, arm))
        logged = [(f"iteration {step}", curve) for step, curve in histograms.items()]
        lines[f"Volumes during training: {arm}"] = logged
    charts = [
        line_chart(title, own, *VOLUME_AXES, log=True, marker=threshold)
        for title, own in lines.items()
    ]
    return list(filter(None, charts)), notes


def _volumes_in_training(trial: TrialResult) -> NDArray[np.float64]:
    """log10 of the volumes [N] of a trial's Gaussians, in its training's cubed units."""
    return log10_volumes(trial.path / layout.POINT_CLOUD) + 3 * math.log10(
        trial.record.to_training.scale
    )


def log10_volumes(path: Path) -> NDArray[np.float64]:
    """log10 of the volumes ``4/3 π s1 s2 s3`` [N] of a 3DGS PLY, whose scales are logs.

    Raises `InputError` for a file that cannot be read as a 3DGS PLY.
    """
    from plyfile import PlyData, PlyParseError  # here, since only reports read point clouds

    try:
        vertices = PlyData.read(path)["vertex"]
        logs = np.sum(
            [np.asarray(vertices[f"scale_{axis}"], dtype=np.float64) for axis in range(3)], axis=0
        )
    except (OSError, ValueError, KeyError, PlyParseError) as error:
        raise InputError(f"{path} is not a readable 3DGS PLY ({error})") from None
    return np.asarray(LOG10_SPHERE + logs / math.log(10))


def histogram(volumes: NDArray[np.float64]) -> Curve:
    """(volume, share) of each filled quarter decade of the finite log10 ``volumes`` [N]."""
    finite = volumes[np.isfinite(volumes)]
    bins, counts = np.unique(np.floor(finite / BIN_WIDTH), return_counts=True)
    centres, shares = 10 ** ((bins + 0.5) * BIN_WIDTH), counts / len(finite)
    return list(zip(centres.tolist(), shares.tolist(), strict=True))


def _logged_histograms(trials: Sequence[TrialResult]) -> dict[int, Curve]:
    """Logged histograms by iteration, pooled over trials, as (bin's centre, share)."""
    pooled: dict[int, dict[float, float]] = defaultdict(lambda: defaultdict(float))
    for trial in trials:
        for row in trial.folder.curves(layout.HISTOGRAMS, Histogram):
            bins = itertools.pairwise(row.log10_edges)
            for (low, high), count in zip(bins, row.counts, strict=True):
                if count:
                    pooled[row.step][10 ** ((low + high) / 2)] += count
    shares = {}
    for step, filled in sorted(pooled.items()):
        total = sum(filled.values())
        shares[step] = [(volume, count / total) for volume, count in sorted(filled.items())]
    return shares


def _threshold(trials: Sequence[TrialResult]) -> float | None:
    """The absolute volume threshold (cubed scene units) that all arms share, or None."""
    configs = [group[0].config for group in group_by(trials, "arm").values()]
    thresholds = [
        config["densify.volume_threshold"]
        for config in configs
        if config.get("densify.threshold_mode", "absolute") == "absolute"
        and "densify.volume_threshold" in config
    ]
    # a damaged file may hold anything
    are_numbers = all(isinstance(value, int | float) for value in thresholds)
    return float(thresholds[0]) if are_numbers and len(set(thresholds)) == 1 else None
