"""Sections of the report, each made from result files only."""

from __future__ import annotations

import logging
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from gsbench.analysis.differences import short_version
from gsbench.analysis.fairness import fairness_table
from gsbench.analysis.judgement import Verdict
from gsbench.analysis.notes import caveats
from gsbench.analysis.pairing import pair_trials
from gsbench.analysis.quantities import COSTS
from gsbench.analysis.report.charts import ForestRow, Series, bar_chart, forest_plot, line_chart
from gsbench.analysis.report.pictures import WholeView, choose_views
from gsbench.analysis.report.volumes import share_above, volume_histogram
from gsbench.analysis.results import Arm, TrialResult, by_key
from gsbench.analysis.tables import Table
from gsbench.analysis.verdicts import PairVerdicts
from gsbench.errors import InputError
from gsbench.eval.facts import find
from gsbench.events import RefineEvent
from gsbench.parsing import DamagedError
from gsbench.runs import layout
from gsbench.runs.experiments import read_tuning
from gsbench.words import counted, signed

log = logging.getLogger(__name__)

COSTS_COMPARED = ("gaussians", "train_time")
EVENT_CAUSES = (*RefineEvent.GROWN, "relocated", *RefineEvent.PRUNED)
CURVES = (  # key of metrics.jsonl, title, y axis
    ("num_gaussians", "Gaussians during training", "Gaussians"),
    ("loss", "Training loss (of single views, averaged over trials)", "loss"),
    ("psnr", "PSNR of test views during training", "PSNR (dB)"),
)


@dataclass(frozen=True)
class Versus:
    """All results about one pair of arms, beside its verdicts (``judged``)."""

    judged: PairVerdicts
    caveats: str  # what else than the idea may have made the difference
    fairness: Table
    costs: tuple[str, ...]
    forests: tuple[str, ...]
    views: tuple[WholeView, ...]
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
    own = [trial for trial in trials if trial.arm in (first, second)]
    pairs = pair_trials(own, first, second)
    views, faults = choose_views(pairs)
    return Versus(
        judged,
        caveats(trials, first, second),
        fairness_table(trials, first, second),
        tuple(_costs(own, first, second)),
        tuple(_forest(verdict) for verdict in judged.verdicts),
        tuple(views),
        tuple(dict.fromkeys([*judged.notes, *faults])),
    )


def training_charts(trials: Sequence[TrialResult], arms: Sequence[Arm]) -> list[str]:
    """Curves by arm, averaged over scenes and seeds at the steps that all trials have."""
    keys = [key for key, _, _ in CURVES]
    means = {arm: _mean_curves(own, layout.CURVES, keys) for arm, own in _by_arm(trials, arms).items()}
    charts = [
        line_chart(title, [Series(str(arm), found[key]) for arm, found in means.items()], "iteration", y_label)
        for key, title, y_label in CURVES
    ]
    return [chart for chart in charts if chart]


def event_charts(trials: Sequence[TrialResult], arms: Sequence[Arm]) -> list[str]:
    """Events by cause: totals of every arm, and over the iterations of each arm."""
    totals = []
    for arm in arms:
        logged = [trial.record.events for trial in trials if trial.arm == arm]
        totals.append(
            (str(arm), {c: statistics.fmean(float(events.get(c, 0)) for events in logged) for c in EVENT_CAUSES})
        )
    causes = [cause for cause in EVENT_CAUSES if any(counts[cause] for _, counts in totals)]
    if not causes:
        return []
    labels = [cause.replace("_", " ") for cause in causes]
    bars = [(name, [counts[cause] for cause in causes]) for name, counts in totals]
    charts = [bar_chart("Refinement by cause, mean of a trial", labels, bars, "Gaussians")]
    for arm, own in _by_arm(trials, arms).items():
        means = _mean_curves(own, layout.EVENTS, causes)
        series = [Series(label, means[cause]) for cause, label in zip(causes, labels, strict=True)]
        charts.append(line_chart(f"Refinement over time: {arm}", series, "iteration", "Gaussians"))
    return [chart for chart in charts if chart]


def _by_arm(trials: Sequence[TrialResult], arms: Sequence[Arm]) -> dict[Arm, list[TrialResult]]:
    groups = by_key(trials, lambda trial: trial.arm)
    return {arm: groups.get(arm, []) for arm in arms}


def _mean_curves(trials: Sequence[TrialResult], name: str, keys: Sequence[str]) -> dict[str, list[tuple[float, float]]]:
    """The mean over trials of each key of a file of curves, which is read once."""
    found: dict[str, list[list[tuple[float, float]]]] = {key: [] for key in keys}
    for trial in trials:
        rows = trial.folder.rows(name)
        for key, curves in found.items():
            curves.append([(float(row["step"]), float(row[key])) for row in rows if key in row])
    return {key: mean_by_step(curves) for key, curves in found.items()}


def volume_charts(trials: Sequence[TrialResult], arms: Sequence[Arm]) -> tuple[list[str], list[str]]:
    """(charts, notes): histograms of the Gaussians' volumes, final by arm and at earlier iterations where logged."""
    notes: list[str] = []
    final = []
    threshold = _threshold(trials)
    for arm in arms:
        own = [trial for trial in trials if trial.arm == arm]
        try:
            final.append(Series(str(arm), volume_histogram(own)))
            if threshold:
                notes.append(f"{arm}: {share_above(own, threshold):.2%} of volumes exceed {threshold:g}.")
        except InputError as error:
            notes.append(f"{arm}: no histogram, {error}")
    marker = (threshold, f"V_th {threshold:g}") if threshold else None
    title = "Volumes of the trained Gaussians"
    charts = [line_chart(title, final, "volume (cubed scene units)", "share", log_x=True, log_y=True, marker=marker)]
    for arm in arms:
        own = [trial for trial in trials if trial.arm == arm]
        series = [Series(f"iteration {step}", points) for step, points in _logged_histograms(own).items()]
        title = f"Volumes during training: {arm}"
        charts.append(
            line_chart(title, series, "volume (cubed scene units)", "share", log_x=True, log_y=True, marker=marker)
        )
    return [chart for chart in charts if chart], notes


def mean_by_step(curves: Sequence[Sequence[tuple[float, float]]]) -> list[tuple[float, float]]:
    """The mean curve over the steps that every non-empty curve has."""
    filled = [dict(curve) for curve in curves if curve]
    if not filled:
        return []
    shared = sorted(set.intersection(*(set(curve) for curve in filled)))
    return [(step, statistics.fmean(curve[step] for curve in filled)) for step in shared]


def provenance(trials: Sequence[TrialResult]) -> list[dict[str, str]]:
    """One row a trial: where it lies, what it came from, with which versions."""
    return [
        {
            "trial": trial.label,
            "raster": trial.record.raster,
            "protocol": trial.record.protocol,
            "iterations": str(trial.record.iterations),
            **{f"{key} hash": str(value)[:12] for key, value in trial.record.hashes.items()},
            "code": ", ".join(f"{part} {short_version(version)}" for part, version in trial.code.items()),
            "machine": trial.machine or "",
            "versions": ", ".join(f"{key} {value}" for key, value in trial.record.versions.items()),
        }
        for trial in trials
    ]


def _costs(trials: Sequence[TrialResult], first: Arm, second: Arm) -> list[str]:
    """Say how counts and training times changed over the scenes that both arms have."""
    arms = [[trial for trial in trials if trial.arm == arm] for arm in (first, second)]
    lines = []
    for key in COSTS_COMPARED:
        name, read = COSTS[key]
        change = cost_change(arms[0], arms[1], read)
        if change is not None:
            caution = _unsteady_times(arms) if key == "train_time" else ""
            lines.append(f"{name[0].upper()}{name[1:]} {change_words(*change)}{caution}")
    return lines


def cost_change(
    baseline: Sequence[TrialResult], other: Sequence[TrialResult], read: Callable[[TrialResult], float | None]
) -> tuple[float, float, int] | None:
    """Relative change of a cost over the scenes that both have: (ratio of totals, mean of ratios, scenes)."""
    means = []
    for group in (baseline, other):
        values: dict[str, list[float]] = {}
        for trial in group:
            value = read(trial)
            if value:
                values.setdefault(trial.scene, []).append(value)
        means.append({scene: statistics.fmean(found) for scene, found in values.items()})
    scenes = sorted(means[0].keys() & means[1].keys())
    if not scenes:
        return None
    totals = [sum(group[scene] for scene in scenes) for group in means]
    ratios = [means[1][scene] / means[0][scene] for scene in scenes]
    return totals[1] / totals[0] - 1, statistics.fmean(ratios) - 1, len(scenes)


def change_words(of_totals: float, of_scenes: float, scenes: int) -> str:
    """A relative change with its averaging rules named; over one scene there is nothing to average."""
    totals, ratios = (signed(value, ".1%") for value in (of_totals, of_scenes))
    if scenes == 1:
        return totals
    return f"{totals} as a ratio of totals, {ratios} as the mean of {scenes} scenes"


def _unsteady_times(arms: Sequence[Sequence[TrialResult]]) -> str:
    """Say how far the training times of equal trials differ, without which a change of them says little."""
    cells = by_key([trial for arm in arms for trial in arm], lambda trial: (trial.arm, trial.scene)).values()
    times = [[t for trial in cell if (t := COSTS["train_time"][1](trial))] for cell in cells]
    spread = max((max(own) / min(own) - 1 for own in times if own), default=0.0)
    return f"; times of equal trials differ by up to {spread:.0%}" if spread else ""


def _forest(verdict: Verdict) -> str:
    rows = [
        ForestRow(s.scene, s.mean, s.interval.low if s.interval else None, s.interval.high if s.interval else None)
        for s in verdict.scenes
    ]
    if len(rows) > 1:
        interval = verdict.interval
        bounds = (interval.low, interval.high) if interval else (None, None)
        rows.append(ForestRow("mean of scenes", verdict.mean or 0.0, *bounds))
    better = "right of zero is better" if verdict.quantity.direction > 0 else "left of zero is better"
    return forest_plot(f"{verdict.quantity.name}: {better}", rows, "difference", verdict.quantity.direction)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float)


def _logged_histograms(trials: Sequence[TrialResult]) -> dict[int, list[tuple[float, float]]]:
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
    return float(found.pop()) if len(found) == 1 and all(map(_is_number, found)) else None


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
    return line, line_chart("The search", [Series("each point", each)], "point", name)
