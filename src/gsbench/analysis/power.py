"""Power of a test: its chance to see a difference of a given size, and the seeds that this takes."""

from __future__ import annotations

import math

from scipy import special

from gsbench.analysis.statistics import ALPHA

POWER = 0.8
MAX_SEEDS = 1000
LARGEST_SHIFT = 30.0  # in standard errors; beyond it scipy's noncentral t gives nan, and all is seen


def seeds_needed(deviation: float, scenes: int, difference: float) -> int | None:
    """Seeds per arm and scene for a two-sided 5 % t test to see ``difference`` of the mean over ``scenes``.

    ``deviation`` is that of the pairs of trials. None above ``MAX_SEEDS``. The noncentral t distribution gives the
    power; more seeds do not tell more about other scenes.
    """
    for seeds in range(2, MAX_SEEDS + 1):
        if t_power(difference, deviation / math.sqrt(scenes * seeds), scenes * seeds - 1) >= POWER:
            return seeds
    return None


def t_power(difference: float, error: float, degrees: int, stretch: float = 1.0) -> float:
    """The chance that a two-sided 5 % t test sees ``difference``, with this standard error and degrees of freedom.

    By the noncentral t distribution; the far tail of the wrong sign is left out. ``stretch`` is how many times larger
    than ``error`` the test takes the standard error to be, where something else spreads its units besides.
    """
    if error == 0:
        return 1.0 if difference else 0.0
    shift = min(difference / error, LARGEST_SHIFT)
    return float(1 - special.nctdtr(degrees, shift, stretch * special.stdtrit(degrees, 1 - ALPHA / 2)))
