"""Charts of sweeps: the question's metric against a setting, with intervals and the baseline."""

from gsbench.analysis.comparison import Answer, Comparison
from gsbench.analysis.report.charts import line_chart
from gsbench.analysis.results import group_by
from gsbench.analysis.statistics import Interval

FEWEST = 3  # values that make a chart
WIDE = 20.0  # ratio of values from which their axis is logarithmic


def sweep_charts(comparison: Comparison) -> list[str]:
    """A chart for each idea of which one setting with numbers was swept."""
    charts = []
    swept = [answer for answer in comparison.answers if _value(answer) is not None]
    for (baseline, name, key, metric), own in group_by(
        swept,
        lambda one: (one.baseline, one.arm.name, one.arm.variant[0][0], one.verdict.quantity),
    ).items():
        points = {
            value: one.verdict
            for one in own
            if (value := _value(one)) is not None
            and one.verdict.mean is not None
            and not one.verdict.question.relative
        }
        if len(points) < FEWEST:
            continue
        level = [verdict.pairs.baseline for verdict in points.values()]
        middle = sum(level) / len(level)
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


def _value(answer: Answer) -> float | None:
    """The value of the one setting that was swept; None if there are others, or it is no number."""
    if len(answer.arm.variant) != 1:
        return None
    try:
        return float(answer.arm.variant[0][1])
    except ValueError:
        return None
