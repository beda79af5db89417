"""Thresholds: standard errors that a mean over scenes needs to be significant at a level.

With one scene it is Student's threshold with K - 1 degrees of freedom, for K seeds. With several
scenes it is lower, the more evenly they share the variance: ``student ** (1 - f) * normal ** f``,
where ``normal`` is the threshold of the normal distribution. The part f in 0..1 depends on the
numbers of scenes and seeds, on the level, and on how ``even`` the shares are: log(1 / largest
share) / log(scenes), 0 if one scene has all variance and 1 if all have the same.
`scripts/regions.py` chose f for the greatest power among all f that keep the level for every ratio
of noise (findings/simulations.md, "Thresholds"); it is tabulated in ``thresholds.npz``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import special

Array = NDArray[np.float64]

TABLE = Path(__file__).with_name("thresholds.npz")
# Below this level the tabulated thresholds are too low for some ratios of noise (their size at .5 %
# is .58 %), so Student's threshold, which is larger, decides.
LEAST_LEVEL = 0.005
LEAST_P, MOST_P = 1e-12, 0.99  # the p between which thresholds are computed
STEPS = 45  # of the bisection for p, which halve its relative error each


@cache
def table() -> Mapping[str, Array]:
    """f [S, K, L, Y] at numbers of ``scenes`` and ``seeds``, ``levels`` (falling) and ``knots``.

    Knots are evennesses.
    """
    with np.load(TABLE) as file:
        return {name: file[name].astype(np.float64) for name in file.files}


@cache
def _curves(scenes: int, seeds: int) -> Array:
    """f at the levels and knots [L, Y], interpolated between numbers of scenes and seeds.

    Beyond the table its last row or column holds.
    """
    known = table()
    f = known["f"]
    for number, own in ((np.log(scenes), np.log(known["scenes"])), (seeds, known["seeds"])):
        f = _between(f, float(np.interp(number, own, np.arange(len(own)))))
    return f


def _between(values: Array, place: float) -> Array:
    """The values at a place between two rows."""
    low = min(int(place), len(values) - 2)
    return np.asarray(values[low] + (place - low) * (values[low + 1] - values[low]))


@dataclass(frozen=True, eq=False)
class Region:
    """The thresholds of D means over ``scenes``, each with ``seeds`` pairs.

    ``even`` [D] says how evenly the scenes share the variance (`evenness`).
    """

    scenes: int
    seeds: int
    even: Array

    @cached_property
    def _f(self) -> Array:
        """f at the levels of the table [L, D]."""
        curves = _curves(self.scenes, self.seeds) * (self.scenes > 1)
        return np.stack([np.interp(self.even, table()["knots"], curve) for curve in curves])

    def limits(self, level: Array | float) -> Array:
        """The thresholds [D] at a level, or at one for each mean."""
        row, part = _place(level)
        which = np.arange(len(self.even))
        f = self._f[row, which] + part * (self._f[row + 1, which] - self._f[row, which])
        f = np.where(np.less(level, LEAST_LEVEL), 0.0, f)
        return np.asarray(self._student(level) * np.exp(f * self._ratio(level)))

    def p_values(self, sizes: Array) -> Array:
        """The two-sided p [D] of means with these ``sizes`` [D] in standard errors."""
        low, high = np.full(sizes.shape, np.log(LEAST_P)), np.zeros(sizes.shape)
        for _ in range(STEPS):
            middle = (low + high) / 2
            significant = sizes > self.limits(np.exp(middle))
            low, high = np.where(significant, low, middle), np.where(significant, middle, high)
        return np.exp(high)

    def _student(self, level: Array | float) -> Array:
        return np.asarray(-special.stdtrit(self.seeds - 1, np.asarray(level) / 2))

    def _ratio(self, level: Array | float) -> Array:
        """log(normal / Student's threshold); below the lowest level of the table, that of it."""
        own = np.clip(level, table()["levels"][-1], MOST_P)
        return np.asarray(np.log(-special.ndtri(own / 2) / self._student(own)))


def _place(level: Array | float) -> tuple[NDArray[np.int64], Array]:
    """Between which two levels of the table a level is: the first one's row, and how far."""
    levels = table()["levels"]
    rows = np.arange(len(levels), dtype=np.float64)
    place = np.interp(-np.log(level), -np.log(levels), rows)
    low = np.minimum(place.astype(np.int64), len(levels) - 2)
    return low, place - low


def evenness(variances: Array) -> Array:
    """The evenness, 0 to 1, with which scenes share their estimated ``variances`` [..., S]."""
    scenes = variances.shape[-1]
    total, largest = variances.sum(axis=-1), variances.max(axis=-1)
    if scenes == 1:
        return np.zeros_like(total)
    shares = np.divide(total, largest, out=np.ones_like(total), where=largest > 0)
    return np.asarray(np.log(shares) / np.log(scenes))
