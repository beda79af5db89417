"""Quality against the number of Gaussians: how many fewer an arm needs for equal quality.

Each arm is trained at several counts. As in Bjøntegaard's difference of rates (VCEG-M33, 2001), the
logarithm of the count is interpolated over quality, and the difference of two arms is averaged over
the range of quality that both reach. The interpolation is monotone (PCHIP), since a cubic
polynomial may turn between the points. For four counts, each twice the one before, and curves like
those of LPIPS it errs by less than 1 % of the counts. It is an estimate, no test: a verdict needs a
question that was asked before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.statistics import Interval, t_test
from gsbench.errors import InputError

LEAST_COMMON = 0.5  # the smallest common part of the larger range of quality that is averaged over
FEWEST_POINTS = 3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    """One arm's trainings of one scene and seed: counts [P] and qualities [P] (more is better)."""

    counts: Array
    qualities: Array

    @classmethod
    def of(cls, counts: Sequence[float], values: Sequence[float], direction: int) -> Curve:
        """The curve of a metric's values; ``direction`` is -1 if less is better.

        Raises InputError for fewer than three points, for a count that is not positive, and for
        values that are not finite.
        """
        order = np.argsort(counts, kind="stable")
        found = cls(
            np.asarray(counts, dtype=float)[order], direction * np.asarray(values, float)[order]
        )
        if len(found.counts) < FEWEST_POINTS:
            raise InputError(f"a curve needs {FEWEST_POINTS} counts, got {len(found.counts)}")
        if not (np.isfinite(found.qualities).all() and found.counts.min() > 0):
            raise InputError("a curve needs positive counts and finite values")
        return found

    @property
    def is_monotone(self) -> bool:
        """Return whether each larger count has a better quality."""
        return bool((np.diff(self.counts) > 0).all() and (np.diff(self.qualities) > 0).all())


@dataclass(frozen=True)
class CountRatio:
    """The natural logarithm of an arm's count over the baseline's at equal quality.

    ``log_ratio`` is None if the curves cannot be compared, and ``why_not`` says why. If one arm is
    better at its fewest Gaussians than the other at its most, ``bound`` holds the logarithm that
    the ratio is below (the arm is better) or above (the baseline is).
    """

    log_ratio: float | None
    why_not: str = ""
    bound: float | None = None


def count_ratio(arm: Curve, baseline: Curve) -> CountRatio:
    """The mean log ratio of counts, arm over baseline, over the quality that both reach."""
    from scipy.interpolate import PchipInterpolator

    for name, curve in (("arm", arm), ("baseline", baseline)):
        if not curve.is_monotone:
            return CountRatio(None, f"more Gaussians do not always give the {name} better quality")
    low = max(arm.qualities[0], baseline.qualities[0])
    high = min(arm.qualities[-1], baseline.qualities[-1])
    if high <= low:
        ahead, behind = (
            (arm, baseline) if arm.qualities[0] >= baseline.qualities[-1] else (baseline, arm)
        )
        edge = float(np.log(ahead.counts[0] / behind.counts[-1]))
        better = "arm" if ahead is arm else "baseline"
        why = f"the {better} is better with its fewest Gaussians than the other with its most"
        return CountRatio(None, why, edge if ahead is arm else -edge)
    larger = max(float(np.ptp(curve.qualities)) for curve in (arm, baseline))
    share = float(high - low) / larger
    if share < LEAST_COMMON:
        return CountRatio(None, f"only {share:.0%} of the range of quality is common")
    integrals = [
        PchipInterpolator(curve.qualities, np.log(curve.counts)).integrate(low, high)
        for curve in (arm, baseline)
    ]
    return CountRatio(float(integrals[0] - integrals[1]) / float(high - low))


@dataclass(frozen=True)
class CountSaving:
    """The mean ratio of counts minus 1, with its interval; None where pairs cannot tell."""

    change: float | None  # -0.27: 27 % fewer Gaussians
    interval: Interval | None
    pairs: int
    why_not: tuple[str, ...] = ()  # why pairs have no ratio, each reason once
    bound: float | None = None  # the change is at least as large, if every pair says so

    @property
    def words(self) -> str:
        """A phrase such as "27 % fewer Gaussians (12 to 38 %)"."""
        if self.bound is not None:
            return f"at least {_amount(self.bound)}"
        if self.change is None:
            return f"not comparable: {'; '.join(self.why_not)}"
        text = _amount(self.change)
        if self.interval is None:
            return f"{text} (one pair: no interval)"
        low, high = self.interval.low, self.interval.high
        if low < 0 < high:
            return f"{text} ({100 * -low:.0f} % fewer to {100 * high:.0f} % more)"
        near, far = sorted((abs(low), abs(high)))
        return f"{text} ({100 * near:.0f} to {100 * far:.0f} %)"


def _amount(change: float) -> str:
    return f"{100 * abs(change):.0f} % {'fewer' if change < 0 else 'more'} Gaussians"


def count_saving(ratios: Sequence[Sequence[CountRatio]], alpha: float = 0.05) -> CountSaving:
    """The mean over scenes of ``ratios`` [S][K], with a t interval over pairs of trainings.

    It is the interval of the test over these scenes (`t_test`), of the mean log ratio. All pairs
    must have a ratio, since leaving out those that cannot be compared would leave out the largest
    differences.
    """
    flat = [one for row in ratios for one in row]
    reasons = tuple(dict.fromkeys(one.why_not for one in flat if one.why_not))
    if reasons or not flat:
        bounds = [one.bound for one in flat if one.bound is not None]
        same_side = len(bounds) == len(flat) > 0 and len(set(np.sign(bounds))) == 1
        bound = float(np.expm1(min(bounds, key=abs))) if same_side else None
        return CountSaving(None, None, len(flat), reasons or ("no pair of trainings",), bound)
    fewest = min(map(len, ratios))
    values = np.array([[one.log_ratio for one in row[:fewest]] for row in ratios], dtype=float)
    test = t_test(values)
    interval = None if test is None else test.interval(alpha)
    if interval is not None:
        interval = Interval(*np.expm1([interval.low, interval.high]))
    return CountSaving(float(np.expm1(values.mean())), interval, values.size)
