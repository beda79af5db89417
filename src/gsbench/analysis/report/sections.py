"""Sections of the report, each made from result files only."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.differences import short_version
from gsbench.analysis.fairness import caveats, fairness_table
from gsbench.analysis.images import ViewComparison, choose_views
from gsbench.analysis.judgement import Verdict
from gsbench.analysis.pairing import pair_trials
from gsbench.analysis.quantities import COSTS, relative_change
from gsbench.analysis.report.charts import ForestRow, forest_plot, line_chart
from gsbench.analysis.results import Arm, TrialResult, by_key
from gsbench.analysis.table_formats import Column, Entry, Row, Table
from gsbench.analysis.verdicts import PairVerdicts
from gsbench.errors import InputError
from gsbench.eval.facts import find
from gsbench.events import RefineEvent
from gsbench.parsing import DamagedError
from gsbench.runs import layout
from gsbench.runs.experiments import read_tuning
from gsbench.words import counted

log = logging.getLogger(__name__)

COSTS_COMPARED = ("gaussians", "train_time")
EVENT_CAUSES = (*RefineEvent.GROWN, "relocated", *RefineEvent.PRUNED)
CURVES = (  # key of metrics.jsonl, title, y axis
    ("num_gaussians", "Gaussians during training", "Gaussians"),
    ("loss", "Training loss (of single views, averaged over trials)", "loss"),
    ("psnr", "PSNR of test views during training", "PSNR (dB)"),
)
VOLUME_AXES = ("volume (cubed scene units)", "share")
LOG10_SPHERE = math.log10(4 / 3 * math.pi)
BIN_WIDTH = 0.25  # decades of volume

Curve = list[tuple[float, float]]


@dataclass(frozen=True)
class Versus:
    """All results about one pair of arms, beside its verdicts (``judged``)."""

    judged: PairVerdicts
    caveats: str  # what else than the idea may have made the difference
    fairness: Table
    costs: tuple[str, ...]
    forests: tuple[str, ...]
    views: tuple[ViewComparison, ...]
    notes: tuple[str, ...]

    @property
    def title(self) -> str:
        return f"{self.judged.second} against {self.judged.first}"

    @property
    def beyond(self) -> bool:
        """Return whether there are scenes enough to ask about scenes like these."""
        return any(one.like_these is not None for one in self.judged.verdicts)


def compare_arms(trials: Sequence[TrialResult], judged: PairVerdicts) -> Versus:
    """Costs, forest plots and whole views of two arms; what cannot be had is said in the notes."""
    first, second = judged.first, judged.second
    views, faults = choose_views(pair_trials(trials, first, second))
    return Versus(
        judged,
        caveats(trials, first, second),
        fairness_table(trials, first, second),
        tuple(_costs(trials, first, second)),
        tuple(_forest(verdict) for verdict in judged.verdicts),
        tuple(views),
        tuple(dict.fromkeys([*judged.notes, *faults])),
    )


def _costs(trials: Sequence[TrialResult], first: Arm, second: Arm) -> list[str]:
    """Say how counts and training times changed over the scenes that both arms have."""
    baseline, other = _of(trials, first), _of(trials, second)
    lines = []
    for key in COSTS_COMPARED:
        name, read = COSTS[key]
        change = relative_change(baseline, other, read)
        if change is not None:
            caution = _unsteady_times([*baseline, *other]) if key == "train_time" else ""
            lines.append(f"{name[0].upper()}{name[1:]} {change}{caution}")
    return lines


def _unsteady_times(trials: Sequence[TrialResult]) -> str:
    """Say how far the training times of equal trials differ, without which a change of them says little."""
    cells = by_key(trials, lambda trial: (trial.arm, trial.scene)).values()
    times = [[t for trial in cell if (t := COSTS["train_time"][1](trial))] for cell in cells]
    spread = max((max(own) / min(own) - 1 for own in times if own), default=0.0)
    return f"; times of equal trials differ by up to {spread:.0%}" if spread else ""


def _forest(verdict: Verdict) -> str:
    rows = [ForestRow(scene.scene, scene.mean, scene.interval) for scene in verdict.scenes]
    if len(rows) > 1:
        rows.append(ForestRow("mean of scenes", verdict.mean or 0.0, verdict.interval))
    better = "right of zero is better" if verdict.quantity.direction > 0 else "left of zero is better"
    return forest_plot(f"{verdict.quantity.name}: {better}", rows, "difference", verdict.quantity.direction)


def training_charts(trials: Sequence[TrialResult], arms: Sequence[Arm]) -> list[str]:
    """Curves by arm, averaged over scenes and seeds at the steps that all trials have."""
    keys = [key for key, _, _ in CURVES]
    means = {arm: _mean_curves(_of(trials, arm), layout.CURVES, keys) for arm in arms}
    charts = [
        line_chart(title, [(str(arm), found[key]) for arm, found in means.items()], "iteration", y_label)
        for key, title, y_label in CURVES
    ]
    return [chart for chart in charts if chart]


def event_table(trials: Sequence[TrialResult], arms: Sequence[Arm]) -> Table | None:
    """A cause of growth or pruning a row: Gaussians of an arm's mean trial; None where none was logged."""
    rows = []
    for cause in EVENT_CAUSES:
        means = [fmean(float(trial.record.events.get(cause, 0)) for trial in _of(trials, arm)) for arm in arms]
        if any(means):
            rows.append(Row((cause.replace("_", " "),), tuple(Entry(f"{mean:,.0f}") for mean in means)))
    columns = tuple(Column("", str(arm), ("events", str(arm))) for arm in arms)
    return Table("Gaussians by cause, mean of a trial", ("cause",), columns, tuple(rows)) if rows else None


def event_charts(trials: Sequence[TrialResult], arms: Sequence[Arm]) -> list[str]:
    """Events by cause over the iterations of each arm."""
    means = {arm: _mean_curves(_of(trials, arm), layout.EVENTS, EVENT_CAUSES) for arm in arms}
    causes = [cause for cause in EVENT_CAUSES if any(count for own in means.values() for _, count in own[cause])]
    charts = []
    for arm, own in means.items():
        series = [(cause.replace("_", " "), own[cause]) for cause in causes]
        charts.append(line_chart(f"Refinement over time: {arm}", series, "iteration", "Gaussians"))
    return [chart for chart in charts if chart]


def _of(trials: Sequence[TrialResult], arm: Arm) -> list[TrialResult]:
    return [trial for trial in trials if trial.arm == arm]


def _mean_curves(trials: Sequence[TrialResult], name: str, keys: Sequence[str]) -> dict[str, Curve]:
    """The mean over trials of each key of a file of curves, which is read once."""
    found: dict[str, list[Curve]] = {key: [] for key in keys}
    for trial in trials:
        rows = trial.folder.rows(name)
        for key, curves in found.items():
            curves.append([(float(row["step"]), float(row[key])) for row in rows if key in row])
    return {key: mean_by_step(curves) for key, curves in found.items()}


def mean_by_step(curves: Sequence[Curve]) -> Curve:
    """The mean curve over the steps that every non-empty curve has."""
    filled = [dict(curve) for curve in curves if curve]
    if not filled:
        return []
    shared = sorted(set.intersection(*(set(curve) for curve in filled)))
    return [(step, fmean(curve[step] for curve in filled)) for step in shared]


def volume_charts(trials: Sequence[TrialResult], arms: Sequence[Arm]) -> tuple[list[str], list[str]]:
    """(charts, notes): histograms of the Gaussians' volumes, final by arm and at earlier iterations where logged."""
    threshold = _threshold(trials)
    final: list[tuple[str, Curve]] = []
    notes = []
    for arm in arms:
        try:
            volumes = np.concatenate([log10_volumes(trial.path / layout.POINT_CLOUD) for trial in _of(trials, arm)])
        except InputError as error:
            notes.append(f"{arm}: no histogram, {error}")
            continue
        final.append((str(arm), histogram(volumes)))
        if threshold:
            notes.append(f"{arm}: {np.mean(volumes > math.log10(threshold)):.2%} of volumes exceed {threshold:g}.")
    charts = [line_chart("Volumes of the trained Gaussians", final, *VOLUME_AXES, log=True, marker=threshold)]
    for arm in arms:
        logged = [(f"iteration {step}", curve) for step, curve in _logged_histograms(_of(trials, arm)).items()]
        title = f"Volumes during training: {arm}"
        charts.append(line_chart(title, logged, *VOLUME_AXES, log=True, marker=threshold))
    return [chart for chart in charts if chart], notes


def log10_volumes(path: Path) -> NDArray[np.float64]:
    """log10 of the volumes ``4/3 π s1 s2 s3`` [N] of a 3DGS PLY, whose scales are natural logarithms.

    Raises `InputError` for a file that is none.
    """
    from plyfile import PlyData, PlyParseError  # here, since only reports read point clouds

    try:
        vertices = PlyData.read(path)["vertex"]
        logs = np.sum([np.asarray(vertices[f"scale_{axis}"], dtype=np.float64) for axis in range(3)], axis=0)
    except (OSError, ValueError, KeyError, PlyParseError) as error:
        raise InputError(f"{path} is not a readable 3DGS PLY ({error})") from None
    return np.asarray(LOG10_SPHERE + logs / math.log(10))


def histogram(volumes: NDArray[np.float64]) -> Curve:
    """(volume, share) of finite log10 ``volumes`` [N] in bins of a quarter decade; only filled bins."""
    finite = volumes[np.isfinite(volumes)]
    bins, counts = np.unique(np.floor(finite / BIN_WIDTH), return_counts=True)
    return list(zip((10 ** ((bins + 0.5) * BIN_WIDTH)).tolist(), (counts / len(finite)).tolist(), strict=True))


def _logged_histograms(trials: Sequence[TrialResult]) -> dict[int, Curve]:
    """Pooled counts of ``volume_histograms.jsonl`` by iteration, as (volume at the bin's centre, share)."""
    pooled: dict[int, dict[float, float]] = {}
    for trial in trials:
        for row in trial.folder.histograms():
            for low, high, count in zip(row.log10_edges, row.log10_edges[1:], row.counts, strict=False):
                bins, volume = pooled.setdefault(row.step, {}), 10 ** ((low + high) / 2)
                bins[volume] = bins.get(volume, 0.0) + count
    return {
        step: [(volume, count / total) for volume, count in sorted(bins.items()) if count]
        for step, bins in sorted(pooled.items())
        if (total := sum(bins.values()))
    }


def _threshold(trials: Sequence[TrialResult]) -> float | None:
    """The volume threshold in scene units, where every arm that has one has this one."""
    settings = [group[0].config for group in by_key(trials, lambda trial: trial.arm).values()]
    found = {
        config["densify.volume_threshold"]
        for config in settings
        if config.get("densify.threshold_mode", "absolute") == "absolute" and "densify.volume_threshold" in config
    }
    known = len(found) == 1 and all(isinstance(value, int | float) for value in found)
    return float(found.pop()) if known else None


def provenance(trials: Sequence[TrialResult]) -> Table:
    """One row a trial: where it lies, what it came from, with which versions."""
    found = {
        trial.label: {
            "raster": trial.record.raster,
            "protocol": trial.record.protocol,
            "iterations": str(trial.record.iterations),
            **{f"{key} hash": str(value)[:12] for key, value in trial.record.hashes.items()},
            "code": ", ".join(f"{part} {short_version(version)}" for part, version in trial.code.items()),
            "machine": trial.machine or "",
            "versions": ", ".join(f"{key} {value}" for key, value in trial.record.versions.items()),
        }
        for trial in trials
    }
    names = dict.fromkeys(name for facts in found.values() for name in facts)
    columns = tuple(Column("", name, ("provenance", name)) for name in names)
    rows = (Row((label,), tuple(Entry(facts.get(name, "")) for name in names)) for label, facts in found.items())
    return Table("Trials", ("trial",), columns, tuple(rows), wrapped=True)


def search_part(home: Path) -> tuple[str, str] | None:
    """A line on the search of an experiment and its chart as SVG; None where there was none, or it cannot be read."""
    try:
        record = read_tuning(home)
    except FileNotFoundError:
        return None
    except DamagedError as error:
        log.warning("left out: %s", error)
        return None
    done = [(number, point, point.value) for number, point in enumerate(record.points, 1) if point.value is not None]
    failed = len(record.points) - len(done)
    count = f"{len(record.points)} of {counted(record.wanted, 'point')}, each {counted(len(record.seeds), 'seed')}"
    count += f"; {failed} failed" if failed else ""
    if not done:
        return f"{count}; none has a result yet.", ""
    facts = find(record.metric)
    name, decimals = (facts.name, facts.decimals + 1) if facts else (record.metric, 4)
    number, best, highest = max(done, key=lambda found: record.direction * found[2])
    where = ", ".join(f"{key} = {value}" for key, value in best.settings.items())
    line = f"Best {name}: {highest:.{decimals}f} at {where} (point {number}). {count}. "
    line += "Judged by validation views; no test view was looked at."
    each = [(float(place), value) for place, _, value in done]
    return line, line_chart("The search", [("each point", each)], "point", name)
