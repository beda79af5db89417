"""Arms ranked over scenes, with the critical difference of Nemenyi's test (Demšar 2006, JMLR 7, 1).

Scenes are the units, as in statements about scenes like these. A ranking shows all arms at once; it
is not a verdict.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsbench.analysis.cells import check_averageable, make_cell
from gsbench.analysis.differences import differing_conditions
from gsbench.analysis.quantities import Quantity
from gsbench.analysis.results import Arm, TrialResult, group_by
from gsbench.analysis.statistics import ALPHA, MIN_SCENES
from gsbench.errors import InputError


@dataclass(frozen=True)
class Ranking:
    """Mean ranks of ``arms`` over ``scenes`` in a metric, 1 for the best, which comes first.

    Two arms differ (5 %, all pairs together) if their mean ranks differ by ``critical`` or more.
    ``p`` is that of Friedman's test that no arm differs; None for two arms, for which it is not
    defined.
    """

    quantity: Quantity
    arms: tuple[Arm, ...]
    ranks: tuple[float, ...]
    scenes: tuple[str, ...]
    critical: float
    p: float | None

    @property
    def groups(self) -> list[tuple[int, int]]:
        """The first and the last place of each largest group of arms that do not differ."""
        ends = [
            max(k for k, rank in enumerate(self.ranks) if rank - first < self.critical)
            for first in self.ranks
        ]
        return [
            (first, last)
            for first, last in enumerate(ends)
            if last > first and last not in ends[:first]
        ]


def rank_arms(trials: Sequence[TrialResult], quantity: Quantity) -> Ranking | None:
    """The ranking of all arms; None if the quantity has no direction, or if there is one arm.

    It needs `MIN_SCENES` scenes on which all arms have trials that can be compared; below, the
    result is None too.
    """
    arms = sorted({trial.arm for trial in trials})
    means: dict[str, list[float]] = {}
    for scene, own in group_by(trials, lambda trial: trial.scene).items():
        try:
            means[scene] = _means(own, arms, quantity)
        except InputError:
            continue  # the tables report it
    if len(means) < MIN_SCENES or len(arms) < 2 or not quantity.direction:
        return None
    from scipy import stats  # here, since it is slow to import

    values = -quantity.direction * np.array(list(means.values()))  # [S, A], less is better
    ranks = stats.rankdata(values, axis=1).mean(axis=0)
    with np.errstate(invalid="ignore"):  # NaN if all arms are equal on all scenes
        p = float(stats.friedmanchisquare(*values.T).pvalue) if len(arms) > 2 else None
    order = np.argsort(ranks, kind="stable")
    return Ranking(
        quantity,
        tuple(arms[k] for k in order),
        tuple(float(ranks[k]) for k in order),
        tuple(means),
        critical_difference(len(arms), len(means)),
        p if p is None or math.isfinite(p) else 1.0,
    )


def _means(trials: Sequence[TrialResult], arms: Sequence[Arm], quantity: Quantity) -> list[float]:
    """The mean of each arm on the scene of ``trials``.

    Raises InputError if one is missing or cannot be compared.
    """
    if differing_conditions(trials):
        raise InputError("the arms differ in their conditions")
    by_arm = group_by(trials, lambda trial: trial.arm)
    means = []
    for arm in arms:
        own = by_arm.get(arm, [])
        check_averageable(own, str(arm))
        mean = make_cell(own, quantity, [trials[0].scene], 1).mean
        if mean is None:
            raise InputError(f"{arm} has no {quantity.name}")
        means.append(mean)
    return means


def critical_difference(arms: int, scenes: int, level: float = ALPHA) -> float:
    """The least difference of mean ranks of different ``arms``: ``q sqrt(k (k + 1) / 6 N)``.

    q is the upper quantile of the studentized range for infinite degrees of freedom, divided by the
    root of 2.
    """
    from scipy import stats

    q = float(stats.studentized_range.ppf(1 - level, arms, np.inf)) / math.sqrt(2)
    return q * math.sqrt(arms * (arms + 1) / (6 * scenes))


def rank_all(trials: Sequence[TrialResult], quantities: Sequence[Quantity]) -> list[Ranking]:
    """The ranking in each of ``quantities`` that is no cost and has one."""
    return [
        ranking
        for quantity in quantities
        if not quantity.cost and (ranking := rank_arms(trials, quantity)) is not None
    ]
