"""Designs of two arms: numbers of scenes and seeds, and their power.

The paired difference of scene s and seed k is ``mean + scene effect + noise``. The scene
effect has one deviation between scenes, the noise another one between trainings of a scene. Both
are estimated from pilot trials by the analysis of variance (Searle, Casella and McCulloch 1992,
*Variance components*, section 3.6). More seeds shrink only the noise; a statement about scenes like
these needs more scenes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gsbench.analysis.statistics import ALPHA, MIN_SCENES, sign_test_needs
from gsbench.analysis.thresholds import Region, evenness
from gsbench.errors import InputError

POWER = 0.8  # of planned designs: that of the two-sided tests with the error rate ``ALPHA``
MAX_SCENES, MAX_SEEDS = 30, 40  # the largest designs that are considered
DESIGN_DRAWS = 2000  # simulated variances of a design; they give its power to about 0.005


@dataclass(frozen=True)
class Components:
    """Deviations of paired differences, ``between`` scenes and ``within`` a scene.

    ``between`` is the deviation of the effect over scenes: None for a single scene, 0 if scenes
    differ by no more than trainings explain. ``within`` is the deviation over trainings of a
    scene, in the root mean square of the scenes; ``shares`` are the parts of its square that each
    scene has, with a mean of 1.
    """

    between: float | None
    within: float
    scenes: int
    trials: int  # pairs
    shares: tuple[float, ...] = (1.0,)

    def shares_of(self, scenes: int) -> tuple[float, ...]:
        """The shares of so many scenes like the pilot's: evenly spaced quantiles of its own."""
        middles = (np.arange(scenes) + 0.5) / scenes
        found = np.quantile(self.shares, middles, method="inverted_cdf")
        return tuple(map(float, found / found.mean()))


@dataclass(frozen=True)
class Design:
    """A design of two arms on ``scenes`` scenes, with ``seeds`` seeds each."""

    scenes: int
    seeds: int

    @property
    def trials(self) -> int:
        return 2 * self.scenes * self.seeds


def estimate_components(differences: Sequence[NDArray[np.float64]]) -> Components:
    """Estimate the two deviations from pilot trials' paired differences, an array per scene.

    Raises InputError if no scene has two pairs.
    """
    degrees = sum(len(values) - 1 for values in differences)
    if degrees == 0:
        raise InputError("planning needs pilot trials with at least two seeds of one scene")
    within = math.sqrt(
        sum(float(((values - values.mean()) ** 2).sum()) for values in differences) / degrees
    )
    counts = np.array([len(values) for values in differences], dtype=float)
    total = int(counts.sum())
    between, shares = None, tuple[float, ...]([1.0])
    if len(differences) > 1:
        shares = _shares(differences)
        means = np.array([values.mean() for values in differences])
        overall = float(np.concatenate(list(differences)).mean())
        # n_0 of unbalanced data
        pairs_per_scene = (total - float((counts**2).sum()) / total) / (len(counts) - 1)
        square = float((counts * (means - overall) ** 2).sum()) / (len(counts) - 1)
        between = math.sqrt(max(0.0, (square - within**2) / pairs_per_scene))
    return Components(between, within, len(differences), total, shares)


def _shares(differences: Sequence[NDArray[np.float64]]) -> tuple[float, ...]:
    """The parts of the noise that scenes with two pairs and more have, with a mean of 1."""
    variances = np.array([values.var(ddof=1) for values in differences if len(values) > 1])
    mean = variances.mean()
    return tuple(map(float, variances / mean)) if mean else (1.0,)


def power(design: Design, difference: float, components: Components, like_these: bool) -> float:
    """The chance that a design shows ``difference`` by the test of its statement.

    The statement is about the mean of these scenes, or about scenes ``like_these`` (the sign
    test). Raises InputError for scenes like these if the pilot had only one scene.
    """
    if not like_these:
        return power_of_mean(
            components.within, design, difference, shares=components.shares_of(design.scenes)
        )
    if components.between is None:
        raise InputError(
            "one scene cannot show how an effect differs between scenes: run pilot trials on two"
        )
    needed = sign_test_needs(design.scenes, ALPHA)
    if needed is None:
        return 0.0
    spread = math.hypot(components.between, components.within / math.sqrt(design.seeds))
    # that one scene's mean has the sign
    chance = float(special.ndtr(abs(difference) / spread)) if spread else 1.0
    return float(special.bdtrc(needed - 1, design.scenes, chance))


def power_of_mean(
    deviation: float,
    design: Design,
    difference: float,
    level: float = ALPHA,
    shares: tuple[float, ...] = (),
) -> float:
    """The chance that the t test of these scenes sees ``difference`` at ``level``.

    Trainings differ by ``deviation``, in the root mean square of the scenes, which have these
    ``shares`` of its square (equal ones by default). The test estimates each scene's variance and
    its own degrees of freedom. Given these, the power is that of a normal mean; the result is its
    average over simulated variances. The far tail of the wrong sign is left out.
    """
    if deviation == 0:
        return 1.0 if difference else 0.0
    shift = abs(difference) / deviation * math.sqrt(design.scenes * design.seeds)
    return float(special.ndtr(shift - _thresholds(design, level, shares)).mean())


@cache
def _thresholds(design: Design, level: float, shares: tuple[float, ...]) -> NDArray[np.float64]:
    """The smallest means [DESIGN_DRAWS] that are significant, in true standard errors.

    Each belongs to one draw of simulated variances of the scenes.
    """
    freedom = design.seeds - 1
    variances = np.random.default_rng(0).chisquare(freedom, (DESIGN_DRAWS, design.scenes)) / freedom
    variances *= shares or 1.0
    error = np.sqrt(variances.mean(axis=1))
    return Region(design.scenes, design.seeds, evenness(variances)).limits(level) * error


def seeds_needed(deviation: float, scenes: int, difference: float) -> int | None:
    """The seeds of each arm that see ``difference`` on these ``scenes`` with a power of `POWER`.

    None above `MAX_SEEDS`.
    """
    designs = (Design(scenes, seeds) for seeds in range(2, MAX_SEEDS + 1))
    return next(
        (
            design.seeds
            for design in designs
            if power_of_mean(deviation, design, difference) >= POWER
        ),
        None,
    )


def designs_needed(difference: float, components: Components, like_these: bool) -> list[Design]:
    """The designs that see ``difference`` with a power of `POWER`, one per number of scenes.

    Each has the fewest seeds. A number of scenes is left out if it needs more than
    ``MAX_SEEDS`` seeds, or no fewer seeds than fewer scenes do. A statement about scenes like
    these starts at ``MIN_SCENES``. Raises InputError for a difference of 0 or one that is not
    finite.
    """
    if difference == 0 or not math.isfinite(difference):
        raise InputError(
            f"the difference to resolve must be a number other than 0, got {difference}"
        )
    chosen: list[Design] = []
    for scenes in range(MIN_SCENES if like_these else 1, MAX_SCENES + 1):
        most = chosen[-1].seeds - 1 if chosen else MAX_SEEDS
        for design in (Design(scenes, seeds) for seeds in range(2, most + 1)):
            if power(design, difference, components, like_these) >= POWER:
                chosen.append(design)
                break
    return chosen
