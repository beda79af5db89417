"""Charts of quality against the number of Gaussians: how many fewer an arm needs for equal quality.

Each arm is trained at several counts. As in Bjøntegaard's difference of rates (VCEG-M33, 2001), the
logarithm of the count is interpolated over quality, and the difference of two arms is averaged over
the range of quality that both reach. The interpolation is monotone (PCHIP), since a cubic
polynomial may turn between the points. For four counts, each twice the one before, and curves like
those of LPIPS it errs by less than 1 % of the counts. It is an estimate, no test: a verdict needs a
question that was asked before.
"""

from collections.abc import Iterable, Sequence
from dataclasses import astuple
from statistics import fmean

import numpy as np

from gsbench.analysis.pairs import BASELINE
from gsbench.analysis.quantities import Quantity
from gsbench.analysis.report.charts import line_chart
from gsbench.analysis.results import TrialResult, group_by
from gsbench.analysis.statistics import t_test
from gsbench.errors import InputError
from gsbench.words import signed

LIMIT = "densify.max_gaussians"
LEAST_COMMON = 0.5  # the smallest common part of the larger range of quality that is averaged over
FEWEST_POINTS = 3

Trials = Sequence[TrialResult]
Points = Sequence[tuple[float, float]]  # Gaussians and value of trainings of one scene and seed


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
    return {seed: points for seed, points in found.items() if len(points) >= FEWEST_POINTS}


def log_ratio(arm: Points, baseline: Points, direction: int) -> float:
    """The mean log ratio of counts, arm over baseline, over the quality that both reach.

    ``direction`` is -1 if less is better. Raises InputError if the curves cannot be compared.
    """
    from scipy.interpolate import PchipInterpolator

    curves = []
    for name, points in (("arm", arm), ("baseline", baseline)):
        counts, qualities = np.array(sorted(points)).T * [[1], [direction]]
        if not ((np.diff(counts) > 0).all() and (np.diff(qualities) > 0).all()):
            raise InputError(f"more Gaussians do not always give the {name} better quality")
        curves.append((qualities, np.log(counts)))
    low = max(qualities[0] for qualities, _ in curves)
    high = min(qualities[-1] for qualities, _ in curves)
    share = (high - low) / max(np.ptp(qualities) for qualities, _ in curves)
    if share < LEAST_COMMON:
        raise InputError(f"only {max(share, 0.0):.0%} of the range of quality is common")
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
