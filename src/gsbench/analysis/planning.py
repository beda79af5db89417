"""Planning from pilot trials: the scenes and seeds that resolve a difference.

A paired difference of scene s and seed k is ``mean + scene effect + noise``: the effect differs between scenes by a
deviation, and trainings of one scene differ by another. From pilot trials both are estimated by the analysis of
variance (Searle, Casella and McCulloch 1992, *Variance components*, section 3.6). More seeds shrink the noise alone; a
statement about scenes like these needs more scenes. Power is that of the two-sided 5 % tests of `analysis.statistics`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gsbench.analysis.statistics import ALPHA, MIN_SCENES, error_and_degrees, sign_test_needs
from gsbench.errors import InputError

POWER = 0.8
MAX_SCENES, MAX_SEEDS = 30, 40  # the largest designs that are looked at
DRAWS = 2000  # of a design's variances: they give its power to about 0.005


@dataclass(frozen=True)
class Components:
    """Deviations of paired differences: of the effect ``between`` scenes, of trainings ``within`` one.

    ``between`` is None where one scene cannot tell; it is 0 where scenes differ by no more than trainings explain.
    """

    between: float | None
    within: float
    scenes: int
    trials: int  # pairs


@dataclass(frozen=True)
class Size:
    """A design of ``scenes`` scenes with ``seeds`` seeds each, two arms."""

    scenes: int
    seeds: int

    @property
    def trials(self) -> int:
        return 2 * self.scenes * self.seeds


def components(differences: Sequence[NDArray[np.float64]]) -> Components:
    """The two deviations from pilot trials: for each scene the mean difference of every pair, by seed.

    Raises InputError where no scene has two pairs.
    """
    degrees = sum(len(values) - 1 for values in differences)
    if degrees == 0:
        raise InputError("planning needs pilot trials with at least two seeds of one scene")
    within = math.sqrt(sum(float(((values - values.mean()) ** 2).sum()) for values in differences) / degrees)
    counts = np.array([len(values) for values in differences], dtype=float)
    total = int(counts.sum())
    between = None
    if len(differences) > 1:
        means = np.array([values.mean() for values in differences])
        overall = float(np.concatenate(list(differences)).mean())
        per_scene = (total - float((counts**2).sum()) / total) / (len(counts) - 1)  # pairs a scene, were all alike
        square = float((counts * (means - overall) ** 2).sum()) / (len(counts) - 1)
        between = math.sqrt(max(0.0, (square - within**2) / per_scene))
    return Components(between, within, len(differences), total)


def power(size: Size, difference: float, found: Components, like_these: bool) -> float:
    """The chance to see ``difference``: in the mean of these scenes, or in how many of ``scenes like these`` it helps.

    Raises InputError where the pilot had one scene and others are asked about.
    """
    if not like_these:
        return power_of_mean(found.within, size, difference)
    if found.between is None:
        raise InputError("one scene cannot show how an effect differs between scenes: run pilot trials on two")
    needed = sign_test_needs(size.scenes, ALPHA)
    if needed is None:
        return 0.0
    spread = math.hypot(found.between, found.within / math.sqrt(size.seeds))
    helps = float(special.ndtr(abs(difference) / spread)) if spread else 1.0  # a scene is seen to be helped
    return float(special.bdtrc(needed - 1, size.scenes, helps))


def power_of_mean(deviation: float, size: Size, difference: float) -> float:
    """The chance that the t test of these scenes sees ``difference``, where trainings differ by ``deviation``.

    The test estimates each scene's variance, and with it its degrees of freedom: the power is the mean over
    simulated variances, given each of which it is that of a normal mean. The far tail of the wrong sign is left out.
    """
    if deviation == 0:
        return 1.0 if difference else 0.0
    shift = abs(difference) / deviation * math.sqrt(size.scenes * size.seeds)
    return float(special.ndtr(shift - _thresholds(size)).mean())


@cache
def _thresholds(size: Size) -> NDArray[np.float64]:
    """Beyond how many of its true standard errors a mean is seen [DRAWS], for simulated variances of the scenes."""
    freedom = size.seeds - 1
    variances = np.random.default_rng(0).chisquare(freedom, (DRAWS, size.scenes)) / freedom
    error, degrees = error_and_degrees(variances, size.seeds)
    return special.stdtrit(degrees, 1 - ALPHA / 2) * error * math.sqrt(size.scenes * size.seeds)


def seeds_needed(deviation: float, scenes: int, difference: float) -> int | None:
    """Seeds of each arm on these ``scenes`` that see ``difference`` with a power of `POWER`; None above `MAX_SEEDS`."""
    sizes = (Size(scenes, seeds) for seeds in range(2, MAX_SEEDS + 1))
    return next((one.seeds for one in sizes if power_of_mean(deviation, one, difference) >= POWER), None)


def sizes_needed(difference: float, found: Components, like_these: bool) -> list[Size]:
    """List the fewest seeds that see ``difference`` with a power of `POWER`, by number of scenes; [] where none do.

    Scenes that would need more seeds than ``MAX_SEEDS`` are left out, and so is what needs more scenes and no fewer
    seeds than a design before it. A statement about scenes like these starts at ``MIN_SCENES``.
    """
    if difference == 0 or not math.isfinite(difference):
        raise InputError(f"the difference to resolve must be a number other than 0, got {difference}")
    chosen: list[Size] = []
    for scenes in range(MIN_SCENES if like_these else 1, MAX_SCENES + 1):
        most = chosen[-1].seeds - 1 if chosen else MAX_SEEDS
        for one in (Size(scenes, seeds) for seeds in range(2, most + 1)):
            if power(one, difference, found, like_these) >= POWER:
                chosen.append(one)
                break
    return chosen
