"""The report's charts of quality against cost."""

from __future__ import annotations

from collections.abc import Sequence

from gsbench.analysis.cells import by_key
from gsbench.analysis.pairing import BASELINE
from gsbench.analysis.quantities import Quantity, quantity
from gsbench.analysis.report.charts import Series, line_chart, short_number
from gsbench.analysis.results import TrialResult
from gsbench.analysis.tradeoffs import Curve, curve_gap, family_curve
from gsbench.eval.facts import METRICS
from gsbench.words import signed

COST_LABELS = {"gaussians": "Gaussians", "seconds": "training time (s)"}


def tradeoff_charts(trials: Sequence[TrialResult]) -> list[str]:
    """One chart for each pair of main metric and cost; a densifier's variants are the points of its line."""
    charts = []
    for where, own in _by_split(trials):
        for metric in main_metrics(own):
            for cost, label in COST_LABELS.items():
                curves = _curves(own, metric, cost)
                series = [
                    Series("-".join(family), list(zip(curve.cost.tolist(), curve.quality.tolist(), strict=True)))
                    for family, curve in curves.items()
                ]
                title = f"{metric.name} against {label}{where}"
                charts.append(line_chart(title, series, label, metric.heading, log_x=True))
    return [chart for chart in charts if chart]


def tradeoff_gaps(trials: Sequence[TrialResult], baseline: str = BASELINE) -> list[str]:
    """The area between every densifier's curve and the baseline's, in words, where both have several points."""
    lines = []
    for where, own in _by_split(trials):
        for metric in main_metrics(own):
            for cost, label in COST_LABELS.items():
                curves = _curves(own, metric, cost)
                for (init, densify), curve in curves.items():
                    first = curves.get((init, baseline))
                    gap = curve_gap(first, curve) if first is not None and densify != baseline else None
                    if gap is not None:
                        amount = signed(gap.gap, f".{metric.decimals + 1}f")
                        arms = f"{init}-{densify} at the same {label} as {init}-{baseline}{where}"
                        scale = f"from {short_number(gap.low)} to {short_number(gap.high)}, log scale"
                        lines.append(f"{metric.name} of {arms}: {amount} on average ({scale}).")
    return lines


def _by_split(trials: Sequence[TrialResult]) -> list[tuple[str, list[TrialResult]]]:
    """The trials by what was held out, with words for it where that is not one way for all."""
    groups = by_key(trials, lambda trial: trial.split)
    return [(f", {split}" if len(groups) > 1 else "", own) for split, own in groups.items()]


def main_metrics(trials: Sequence[TrialResult]) -> list[Quantity]:
    """PSNR, and the first perceptual metric that is at hand, beginning with the protocol's LPIPS."""
    for name in ("lpips", *(facts.key for facts in METRICS if facts.perceptual)):
        perceptual = quantity(name, trials)
        if all(perceptual.read(trial) is not None for trial in trials):
            return [quantity("psnr", trials), perceptual]
    return [quantity("psnr", trials)]


def _curves(trials: Sequence[TrialResult], metric: Quantity, cost: str) -> dict[tuple[str, str], Curve]:
    families = sorted({(trial.init, trial.densify) for trial in trials})
    curves = {family: family_curve(trials, family, metric, cost) for family in families}
    return {family: curve for family, curve in curves.items() if len(curve.cost)}
