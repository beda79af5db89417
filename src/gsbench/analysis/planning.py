"""Numbers of scenes and seeds that a command needs to show a difference of two arms.

The paired difference of scene s and seed k is ``mean + scene effect + noise``. The scene
effect has one deviation between scenes, the noise another one between trainings of a scene. Both
are estimated from pilot trials by the analysis of variance (Searle, Casella and McCulloch 1992,
*Variance components*, section 3.6). More seeds shrink only the noise; a statement about scenes like
these needs more scenes.

Plans are for a question whose seeds are judged at once. Trainings are simulated with the shares of
noise that the pilot's scenes have, and decided by the thresholds of the judge.
"""

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import scipy
from numpy.typing import NDArray

from gsbench.analysis.statistics import ALPHA, MIN_SCENES, Region, evenness, sign_test_needs
from gsbench.errors import InputError

POWER = 0.8  # of planned designs: that of the two-sided tests with the error rate ``ALPHA``
MAX_SCENES, MAX_SEEDS = 30, 40  # the largest designs that are considered
DRAWS = 2000  # simulated variances of a design; they give its power to about 0.005
UNSURE = 0.8  # of pilots have the real deviation within the stated range


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
    counts = np.array([len(values) for values in differences], dtype=float)
    total, repeated = int(counts.sum()), [values for values in differences if len(values) > 1]
    if not repeated:
        raise InputError("planning needs pilot trials with at least two seeds of one scene")
    squares = sum(values.var() * len(values) for values in repeated)
    within = math.sqrt(squares / (total - len(counts)))
    if len(counts) == 1:
        return Components(None, within, 1, total)
    means = np.array([values.mean() for values in differences])
    overall = (counts * means).sum() / total
    # n_0 of unbalanced data
    pairs_per_scene = (total - float((counts**2).sum()) / total) / (len(counts) - 1)
    square = float((counts * (means - overall) ** 2).sum()) / (len(counts) - 1)
    between = math.sqrt(max(0.0, (square - within**2) / pairs_per_scene))
    variances = np.array([values.var(ddof=1) for values in repeated])
    mean = variances.mean()
    shares = tuple(map(float, variances / mean)) if mean else (1.0,)
    return Components(between, within, len(counts), total, shares)


def deviation_range(components: Components) -> tuple[float, float]:
    """The deviations between which that of trainings lies in `UNSURE` of such pilots."""
    degrees = components.trials - components.scenes
    ends = scipy.special.chdtri(degrees, [(1 - UNSURE) / 2, (1 + UNSURE) / 2])
    low, high = map(float, np.sqrt(degrees / ends))
    return components.within * low, components.within * high


# ---- the power of a design


def power_like_these(design: Design, difference: float, components: Components) -> float:
    """The chance that the sign test shows ``difference`` on scenes like these.

    Raises InputError if the pilot had only one scene.
    """
    if components.between is None:
        raise InputError(
            "one scene cannot show how an effect differs between scenes: run pilot trials on two"
        )
    needed = sign_test_needs(design.scenes, ALPHA)
    if needed is None:
        return 0.0
    spread = math.hypot(components.between, components.within / math.sqrt(design.seeds))
    # that one scene's mean has the sign
    chance = float(scipy.special.ndtr(abs(difference) / spread)) if spread else 1.0
    return float(scipy.special.bdtrc(needed - 1, design.scenes, chance))


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
    return float(scipy.special.ndtr(shift - _thresholds(design, level, shares)).mean())


@cache
def _thresholds(design: Design, level: float, shares: tuple[float, ...]) -> NDArray[np.float64]:
    """The smallest means [DRAWS] that are significant, in true standard errors.

    Each belongs to one draw of simulated variances of the scenes.
    """
    freedom = design.seeds - 1
    variances = np.random.default_rng(0).chisquare(freedom, (DRAWS, design.scenes)) / freedom
    variances *= shares or 1.0
    error = np.sqrt(variances.mean(axis=1))
    return Region(design.scenes, design.seeds, evenness(variances)).limits(level) * error


# ---- the designs that suffice


def fewest_seeds(power: Callable[[Design], float], scenes: Iterable[int]) -> list[Design]:
    """The designs with a power of `POWER`, one per number of ``scenes``, with the fewest seeds.

    Those with the fewest trials come first.

    A number of scenes is left out if it needs more than `MAX_SEEDS` seeds, or no fewer seeds than
    fewer scenes do. The power rises with the number of seeds.
    """
    chosen, most = list[Design](), MAX_SEEDS
    for count in scenes:
        designs = [Design(count, seeds) for seeds in range(2, most + 1)]
        weaker = bisect_left(designs, POWER, key=power)  # how many have less power
        if weaker < len(designs):
            chosen.append(designs[weaker])
            most = chosen[-1].seeds - 1
    return sorted(chosen, key=lambda design: (design.trials, design.scenes))


def sweep_power(
    design: Design, difference: float, noise: Components, level: float = ALPHA
) -> float:
    """The chance that a sweep shows ``difference`` where pairs differ as in ``noise``."""
    return power_of_mean(noise.within, design, difference, level, noise.shares_of(design.scenes))


def sweep_designs(difference: float, noise: Components, level: float = ALPHA) -> list[Design]:
    """The designs of sweeps with a power of `POWER`, as `fewest_seeds` gives them."""
    power = partial(sweep_power, difference=difference, noise=noise, level=level)
    return fewest_seeds(power, range(1, MAX_SCENES + 1))


def designs_like_these(difference: float, noise: Components) -> list[Design]:
    """The same for the statement on scenes like these, from `MIN_SCENES` scenes on."""
    power = partial(power_like_these, difference=difference, components=noise)
    return fewest_seeds(power, range(MIN_SCENES, MAX_SCENES + 1))


def seeds_needed(deviation: float, scenes: int, difference: float) -> int | None:
    """The seeds of each arm that see ``difference`` on these ``scenes`` with a power of `POWER`.

    None above `MAX_SEEDS`.
    """
    power = partial(power_of_mean, deviation, difference=difference)
    return next((one.seeds for one in fewest_seeds(power, [scenes])), None)
