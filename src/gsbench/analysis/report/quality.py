"""Charts of quality against the number of Gaussians, with what an arm saves (`analysis.curves`)."""

from collections.abc import Iterable, Sequence
from statistics import fmean

from gsbench.analysis.curves import FEWEST_POINTS, Curve, count_ratio, count_saving
from gsbench.analysis.pairs import BASELINE
from gsbench.analysis.quantities import Quantity
from gsbench.analysis.report.charts import line_chart
from gsbench.analysis.results import TrialResult, group_by

LIMIT = "densify.max_gaussians"

Trials = Sequence[TrialResult]


def quality_charts(trials: Trials, quantities: Iterable[Quantity]) -> list[str]:
    """A chart for each scene, quantity and arm that was trained at three or more limits."""
    charts = []
    of_scene = group_by(trials, lambda trial: (trial.scene, trial.init))
    for quantity in quantities:
        if not quantity.direction or quantity.cost:
            continue
        for (scene, _), own in of_scene.items():
            arms = group_by(own, lambda trial: trial.densify)
            for name, others in arms.items():
                if name != BASELINE and BASELINE in arms:
                    chart = _chart(scene, quantity, name, arms[BASELINE], others)
                    charts.append(chart)
    return list(filter(None, charts))


def _chart(scene: str, quantity: Quantity, name: str, baseline: Trials, arm: Trials) -> str:
    """The chart of two arms; "" if they share no seed that was trained at three limits."""
    sides = [_by_seed(trials, quantity) for trials in (baseline, arm)]
    seeds = sorted(sides[0].keys() & sides[1].keys())
    if not seeds:
        return ""
    curves = [
        [_curve(side[seed], quantity.direction) for side in reversed(sides)] for seed in seeds
    ]
    ratios = [count_ratio(ours, theirs) for ours, theirs in curves]
    lines = []
    for label, side in zip((BASELINE, name), sides, strict=True):
        limits = sorted(set.intersection(*(set(side[seed]) for seed in seeds)))
        points = [
            (
                fmean(side[seed][limit][0] for seed in seeds),
                fmean(side[seed][limit][1] for seed in seeds),
            )
            for limit in limits
        ]
        lines.append((label, points))
    saving = count_saving([ratios]).words
    title = f"{scene}: {name} has the {quantity.name} of {BASELINE} with {saving}"
    if saving.startswith("not comparable"):
        title = f"{scene}, {name} and {BASELINE}: {saving}"
    return line_chart(f"{title}; an estimate, not tested", lines, "Gaussians", quantity.name)


def _by_seed(trials: Trials, quantity: Quantity) -> dict[int, dict[int, tuple[float, float]]]:
    """{seed: {limit: (Gaussians, value)}} of the seeds that were trained at three limits."""
    found: dict[int, dict[int, tuple[float, float]]] = {}
    for trial in trials:
        limit, value = trial.config.get(LIMIT), quantity.read(trial)
        count = trial.record.num_gaussians
        if isinstance(limit, int) and value is not None and count:
            found.setdefault(trial.seed, {})[limit] = float(count), value
    return {seed: points for seed, points in found.items() if len(points) >= FEWEST_POINTS}


def _curve(points: dict[int, tuple[float, float]], direction: int) -> Curve:
    counts, values = zip(*points.values(), strict=True)
    return Curve.of(counts, values, direction)
