"""The curves of the report: numbers and events during training, by arm."""

from collections.abc import Sequence
from statistics import fmean

from gsbench.analysis.report.charts import line_chart
from gsbench.analysis.results import Arm, TrialResult, trials_of
from gsbench.analysis.table_formats import Column, Row, Table, TableEntry
from gsbench.events import RefineEvent
from gsbench.runs import layout

EVENT_CAUSES = (*RefineEvent.GROWN, "relocated", *RefineEvent.PRUNED)
CURVES = (  # key of metrics.jsonl, title, y axis
    ("num_gaussians", "Gaussians during training", "Gaussians"),
    ("loss", "Training loss (of single views, averaged over trials)", "loss"),
    ("psnr", "PSNR of test views during training", "PSNR (dB)"),
)
Curve = list[tuple[float, float]]


def training_charts(trials: Sequence[TrialResult], arms: Sequence[Arm]) -> list[str]:
    """Curves by arm, averaged over scenes and seeds at the steps that all trials have."""
    keys = [key for key, _, _ in CURVES]
    means = {arm: _mean_curves(trials_of(trials, arm), layout.CURVES, keys) for arm in arms}
    charts = []
    for key, title, y_label in CURVES:
        lines = [(str(arm), curves[key]) for arm, curves in means.items()]
        charts.append(line_chart(title, lines, "iteration", y_label))
    return list(filter(None, charts))


def event_table(trials: Sequence[TrialResult], arms: Sequence[Arm]) -> Table | None:
    """A row per cause with the mean number of Gaussians per arm; None if nothing was logged."""
    rows = []
    events_by_arm = [[trial.record.events for trial in trials_of(trials, arm)] for arm in arms]
    for cause in EVENT_CAUSES:
        means = [fmean(float(own.get(cause, 0)) for own in events) for events in events_by_arm]
        if any(means):
            entries = tuple(TableEntry(f"{mean:,.0f}") for mean in means)
            rows.append(Row((cause.replace("_", " "),), entries))
    if not rows:
        return None
    columns = tuple(Column("", str(arm), ("events", str(arm))) for arm in arms)
    return Table("Gaussians by cause, mean of a trial", ("cause",), columns, tuple(rows))


def event_charts(trials: Sequence[TrialResult], arms: Sequence[Arm]) -> list[str]:
    """Events by cause over the iterations of each arm."""
    means = [_mean_curves(trials_of(trials, arm), layout.EVENTS, EVENT_CAUSES) for arm in arms]
    counts = {cause: [dict(own[cause]).values() for own in means] for cause in EVENT_CAUSES}
    # All arms show the same causes, so that a cause has the same colour in every chart.
    causes = [cause for cause, by_arm in counts.items() if any(map(any, by_arm))]
    charts = []
    for arm, own in zip(arms, means, strict=True):
        lines = [(cause.replace("_", " "), own[cause]) for cause in causes]
        title = f"Refinement over time: {arm}"
        charts.append(line_chart(title, lines, "iteration", "Gaussians"))
    return list(filter(None, charts))


def _mean_curves(trials: Sequence[TrialResult], name: str, keys: Sequence[str]) -> dict[str, Curve]:
    """The mean curve over trials of each key in the file ``name``, each file read once."""
    curves_by_key: dict[str, list[Curve]] = {key: [] for key in keys}
    for trial in trials:
        rows = trial.folder.curves(name)
        for key, curves in curves_by_key.items():
            curves.append([(float(row["step"]), float(row[key])) for row in rows if key in row])
    return {key: mean_by_step(curves) for key, curves in curves_by_key.items()}


def mean_by_step(curves: Sequence[Curve]) -> Curve:
    """The mean curve over the steps that every non-empty curve has."""
    filled = [dict(curve) for curve in curves if curve]
    if not filled:
        return []
    shared = sorted(set.intersection(*(set(curve) for curve in filled)))
    return [(step, fmean(curve[step] for curve in filled)) for step in shared]
