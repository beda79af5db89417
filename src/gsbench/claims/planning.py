"""Planning from pilot trials: the scenes and seeds that resolve a difference, and what the hours at hand can resolve.

A paired difference of scene s and seed k is ``mean + scene effect + noise``: the effect differs between scenes by a
deviation, and trainings of one scene differ by another. From pilot trials both are estimated by the analysis of
variance (Searle, Casella and McCulloch 1992, *Variance components*, section 3.6). More seeds shrink the noise alone; a
statement about scenes like these needs more scenes. Power is that of a two-sided 5 % t test (`analysis.power`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.power import POWER, t_power
from gsbench.analysis.statistics import MIN_SCENES, pooled_deviation
from gsbench.errors import InputError

MAX_SCENES, MAX_SEEDS = 30, 40  # the largest designs that are looked at
PRECISION = 1e-6  # of a smallest difference, relative
HOUR = 3600.0


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
    within = pooled_deviation(differences)
    if within is None:
        raise InputError("planning needs pilot trials of two seeds at least in some scene")
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
    """The chance to see ``difference``: in the mean of these scenes, or of ``scenes like these`` where scenes vary.

    The test about these scenes takes pairs of trials as units (`analysis.statistics.student`), so scenes that differ
    make it see less.
    Raises InputError where the pilot had one scene and others are asked about.
    """
    noise = found.within**2 / size.seeds
    if not like_these:
        pairs = size.scenes * size.seeds
        spread = (found.between or 0.0) ** 2 * size.seeds * (size.scenes - 1) / (pairs - 1)  # of scenes, in the test's
        stretch = math.sqrt(1 + spread / found.within**2) if found.within else 1.0
        return t_power(abs(difference), math.sqrt(noise / size.scenes), pairs - 1, stretch=stretch)
    if found.between is None:
        raise InputError("one scene does not tell how an effect differs between scenes: run pilot trials on two")
    return t_power(abs(difference), math.sqrt((found.between**2 + noise) / size.scenes), size.scenes - 1)


def sizes_needed(difference: float, found: Components, like_these: bool) -> list[Size]:
    """List the fewest seeds that see ``difference`` with a power of `POWER`, by number of scenes; [] where none do.

    Scenes that would need more seeds than ``MAX_SEEDS`` are left out, and so is what needs more scenes and no fewer
    seeds than a design before it. A statement about scenes like these starts at ``MIN_SCENES``.
    """
    if difference == 0 or not math.isfinite(difference):
        raise InputError(f"the difference to be resolved must be a number other than 0, got {difference}")
    chosen: list[Size] = []
    for scenes in range(MIN_SCENES if like_these else 1, MAX_SCENES + 1):
        most = chosen[-1].seeds - 1 if chosen else MAX_SEEDS
        for one in (Size(scenes, seeds) for seeds in range(2, most + 1)):
            if power(one, difference, found, like_these) >= POWER:
                chosen.append(one)
                break
    return chosen


def smallest_difference(size: Size, found: Components, like_these: bool) -> float:
    """The smallest difference that the design sees with a power of `POWER`, found by halving."""
    low, high = 0.0, max(found.within, found.between or 0.0)
    if high == 0:
        return 0.0
    while power(size, high, found, like_these) < POWER:
        low, high = high, 2 * high
    while high - low > PRECISION * high:
        middle = (low + high) / 2
        low, high = (low, middle) if power(size, middle, found, like_these) >= POWER else (middle, high)
    return high


def within_hours(hours: float, seconds_per_trial: float, scenes: int) -> Size | None:
    """The design of at most ``scenes`` scenes that fits into ``hours`` of one trial at a time; None if none does.

    Two seeds come before a further scene, since one seed says nothing of how trainings differ.
    """
    if not hours > 0 or not seconds_per_trial > 0:
        raise InputError(f"hours and seconds of a trial must be above 0, got {hours} and {seconds_per_trial}")
    pairs = int(hours * HOUR / (2 * seconds_per_trial))
    if pairs < 2:
        return None
    scenes = min(scenes, pairs // 2)
    return Size(scenes, min(MAX_SEEDS, pairs // scenes))
