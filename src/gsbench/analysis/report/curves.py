"""The curves of the report: training and events by arm, sweeps, and quality by count."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import astuple
from statistics import fmean

import numpy as np

from gsbench.analysis.comparison import Comparison
from gsbench.analysis.pairs import BASELINE
from gsbench.analysis.quantities import Quantity
from gsbench.analysis.report.charts import line_chart
from gsbench.analysis.results import Arm, TrialResult, group_by, trials_of
from gsbench.analysis.statistics import Interval, t_test
from gsbench.analysis.table_formats import Table, text_table
from gsbench.analysis.verdicts import Verdict
from gsbench.errors import InputError
from gsbench.events import RefineEvent
from gsbench.runs import layout
from gsbench.words import signed

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
    rows: dict[str, list[str]] = {}
    events_by_arm = [[trial.record.events for trial in trials_of(trials, arm)] for arm in arms]
    for cause in EVENT_CAUSES:
        means = [fmean(float(own.get(cause, 0)) for own in events) for events in events_by_arm]
        if any(means):
            rows[cause.replace("_", " ")] = [f"{mean:,.0f}" for mean in means]
    title = "Gaussians by cause, mean of a trial"
    return text_table(title, "cause", arms, rows) if rows else None


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


FEWEST = 3  # values of a setting that make a chart
WIDE = 20.0  # ratio of values from which their axis is logarithmic


def sweep_charts(comparison: Comparison) -> list[str]:
    """A chart for each idea of which one setting with numbers was swept."""
    swept: dict[tuple[Arm, str, str, Quantity], dict[float, Verdict]] = {}
    for answer in comparison.answers:
        arm, verdict = answer.arm, answer.verdict
        if len(arm.variant) == 1 and verdict.mean is not None and not verdict.question.relative:
            ((key, value),) = arm.variant
            with suppress(ValueError):  # it is no number
                own = swept.setdefault((answer.baseline, arm.name, key, verdict.quantity), {})
                own[float(value)] = verdict
    charts = []
    for (baseline, name, key, metric), points in swept.items():
        if len(points) < FEWEST:
            continue
        middle = fmean(verdict.pairs.baseline for verdict in points.values())
        line = [(value, middle + (points[value].mean or 0.0)) for value in sorted(points)]
        bars = {
            value: Interval(middle + interval.low, middle + interval.high)
            for value, verdict in points.items()
            if (interval := verdict.interval) is not None
        }
        log = min(points) > 0 and max(points) / min(points) > WIDE
        charts.append(
            line_chart(
                f"{name}: {metric.name} by {key}",
                [(name, line)],
                key,
                metric.name,
                log_x=log,
                bars=bars,
                level=(middle, str(baseline)),
            )
        )
    return charts


# ---- quality against the number of Gaussians: how many fewer an arm needs for equal quality
#
# Each arm is trained at several counts. As in Bjøntegaard's difference of rates (VCEG-M33, 2001),
# the logarithm of the count is interpolated over quality, and the difference of two arms is
# averaged over the range of quality that both reach. The interpolation is monotone (PCHIP), since a
# cubic polynomial may turn between the points. For four counts, each twice the one before, and
# curves like those of LPIPS it errs by less than 1 % of the counts. It is an estimate, no test: a
# verdict needs a question that was asked before.

LIMIT = "densify.max_gaussians"
LEAST_COMMON = 0.5  # the smallest common part of the larger range of quality that is averaged over
Trials = Sequence[TrialResult]


def quality_charts(trials: Trials, quantities: Iterable[Quantity]) -> list[str]:
    """A chart for each scene, quantity and arm that was trained at three or more limits."""
    charts = []
    of_scene = group_by(trials, "scene", "init")
    for quantity in quantities:
        if not quantity.direction or quantity.cost:
            continue
        for (scene, _), own in of_scene.items():
            arms = group_by(own, "densify")
            baseline = arms.pop(BASELINE, [])
            charts += [_chart(scene, quantity, name, baseline, arms[name]) for name in arms]
    return list(filter(None, charts))


def _chart(scene: str, quantity: Quantity, name: str, baseline: Trials, arm: Trials) -> str:
    """The chart of two arms; "" if they share no seed that was trained at three limits."""
    theirs, ours = (_by_seed(trials, quantity) for trials in (baseline, arm))
    seeds = sorted(theirs.keys() & ours.keys())
    if not seeds:
        return ""
    lines = []
    for label, side in ((BASELINE, theirs), (name, ours)):
        limits = sorted(set.intersection(*(set(side[seed]) for seed in seeds)))
        at_limits = ([side[seed][limit] for seed in seeds] for limit in limits)
        lines.append(
            (
                label,
                [(fmean(n), fmean(v)) for n, v in (zip(*own, strict=True) for own in at_limits)],
            )
        )
    try:
        sides = ([*side[seed].values()] for seed in seeds for side in (ours, theirs))
        ratios = [log_ratio(*pair, quantity.direction) for pair in zip(sides, sides, strict=True)]
        title = f"{scene}: {name} has the {quantity.name} of {BASELINE} with {saving_words(ratios)}"
    except InputError as error:
        title = f"{scene}, {name} and {BASELINE}: not comparable: {error}"
    return line_chart(f"{title}; an estimate, not tested", lines, "Gaussians", quantity.name)


def _by_seed(trials: Trials, quantity: Quantity) -> dict[int, dict[int, tuple[float, float]]]:
    """{seed: {limit: (Gaussians, value)}} of the seeds that were trained at three limits."""
    found: dict[int, dict[int, tuple[float, float]]] = {}
    for trial in trials:
        limit, value = trial.config.get(LIMIT), quantity.read(trial)
        count = trial.record.num_gaussians
        if isinstance(limit, int) and value is not None and count:
            found.setdefault(trial.seed, {})[limit] = float(count), value
    return {seed: points for seed, points in found.items() if len(points) >= FEWEST}


def log_ratio(arm: Curve, baseline: Curve, direction: int) -> float:
    """The mean log ratio of counts, arm over baseline, over the quality that both reach.

    ``direction`` is -1 if less is better. Raises InputError if the curves cannot be compared.
    """
    from scipy.interpolate import PchipInterpolator

    curves, ends = [], []
    for name, points in (("arm", arm), ("baseline", baseline)):
        counts, qualities = np.array(sorted(points)).T * [[1], [direction]]
        if not ((np.diff(counts) > 0).all() and (np.diff(qualities) > 0).all()):
            raise InputError(f"more Gaussians do not always give the {name} better quality")
        curves.append((qualities, np.log(counts)))
        ends.append((qualities[0], name, counts[0], counts[-1]))
    low = max(qualities[0] for qualities, _ in curves)
    high = min(qualities[-1] for qualities, _ in curves)
    if high < low:
        (_, worse, _, most), (_, better, fewest, _) = sorted(ends)
        raise InputError(
            f"the {better} with {fewest:,.0f} Gaussians is better than the {worse} with {most:,.0f}"
        )
    share = (high - low) / max(np.ptp(qualities) for qualities, _ in curves)
    if share < LEAST_COMMON:
        raise InputError(f"only {share:.0%} of the range of quality is common")
    ours, theirs = (PchipInterpolator(*curve).integrate(low, high) for curve in curves)
    return float((ours - theirs) / (high - low))


def saving_words(ratios: Sequence[float]) -> str:
    """A phrase such as "27 % fewer Gaussians (−38 to −12 %)", from the log ratios of pairs.

    The interval is Student's over pairs of trainings.
    """
    change, test = float(np.expm1(fmean(ratios))), t_test(np.array([ratios]))
    text = f"{100 * abs(change):.0f} % {'fewer' if change < 0 else 'more'} Gaussians"
    if test is None:
        return f"{text} (one pair: no interval)"
    low, high = (signed(100 * float(np.expm1(end)), ".0f") for end in astuple(test.interval()))
    return f"{text} ({low} to {high} %)"
