"""Planned looks: the numbers of seeds at which a question may be decided, and their levels.

The intervals are repeated confidence intervals (Jennison and Turnbull 1989): at whichever look one
stops, and for whatever reason, the chance of a false statement is at most the rate of the question.
Looks up to the share t of all seeds may spend the part t^1.5 of it (Lan and DeMets 1983; Kim and
DeMets 1987). Looks share trials, so their errors overlap: levels come from simulated trainings.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.thresholds import Region, evenness

Array = NDArray[np.float64]

SPENDING_POWER = 1.5  # exponent of the error-spending function
DRAWS = 100_000  # simulated sequences of trainings
NOISY = (1.0, 4.0, 15.0)  # in these sequences, one scene is so many times as noisy as the others
# Parts of the sequences have a drift with this deviation, and trainings that are as much alike as
# they would be by these chances, so that rare errors are seen more often; ``PLAIN`` parts do not.
DRIFT, ALIKE, PLAIN = 3.0, (0.1, 0.01, 0.001), 4
MOST_LOOKS = 5  # the number of looks, or nearly, that have such parts
STEPS = 40  # of the bisection for a level, which halve its error in logarithms each
FIRST_LOOK = 2  # seeds: one training of each arm does not show how trainings differ
# seeds up to which each seed is a look; more looks would save little and make bounds less precise
EACH_UP_TO = 12


def plan_looks(maximum: int) -> tuple[int, ...]:
    """The numbers of seeds at which there is a look, up to ``maximum``.

    There is one at each number from `FIRST_LOOK` to `EACH_UP_TO`, then at every fourth, and at
    ``maximum``.
    """
    early = range(FIRST_LOOK, min(maximum, EACH_UP_TO) + 1)
    return tuple(dict.fromkeys([*early, *range(EACH_UP_TO, maximum, 4), maximum]))


@cache
def look_levels(
    scenes: int, looks: tuple[int, ...], alpha: float, draws: int = DRAWS
) -> tuple[float, ...]:
    """The error rate of the interval at each look; all looks together have the rate ``alpha``.

    Each is the largest with which no kind of simulated sequences spends more than it may.
    """
    # Equally noisy scenes alone would not do: the test is cautious there, so each look would get
    # all that may be spent.
    simulated = [simulate_looks(1, looks, draws)]
    if scenes > 1:
        simulated += [simulate_looks(scenes, looks, draws, noise) for noise in NOISY]
    # The test itself keeps the level of the first look.
    levels = [alpha * (looks[0] / looks[-1]) ** SPENDING_POWER]
    free = [np.ones(draws, dtype=bool) for _ in simulated]
    spent = np.full(len(simulated), levels[0])
    for look, seeds in enumerate(looks[1:], 1):
        most = alpha * (seeds / looks[-1]) ** SPENDING_POWER
        errors = []
        for one, own in zip(simulated, free, strict=True):
            own &= one.sizes[look - 1] <= one.region(look - 1).limits(levels[-1])
            errors.append(np.flatnonzero(own & (one.sizes[look] > one.region(look).limits(most))))

        low, high = math.log(most) - STEPS, math.log(most)
        if (_rates(simulated, look, errors, most) <= most - spent).all():
            low = high
        for _ in range(STEPS if low < high else 0):
            middle = (low + high) / 2
            fits = (_rates(simulated, look, errors, math.exp(middle)) <= most - spent).all()
            low, high = (middle, high) if fits else (low, middle)
        levels.append(min(most, math.exp(low)))
        spent += _rates(simulated, look, errors, levels[-1])
    return tuple(levels)


@dataclass(frozen=True, eq=False)
class Sequences:
    """Simulated sequences of trainings without an effect, with ``weights`` [D] that sum to 1.

    ``sizes`` [L, D] are means in standard errors at each look; ``even`` [L, D] say how evenly the
    scenes share the variance.
    """

    scenes: int
    looks: tuple[int, ...]
    sizes: Array
    even: Array
    weights: Array

    def region(self, look: int, which: slice | NDArray[np.int64] = slice(None)) -> Region:
        return Region(self.scenes, self.looks[look], self.even[look, which])

    def rate(self, look: int, which: NDArray[np.int64], level: float) -> float:
        """The rate of errors at a look with this level among the sequences ``which``."""
        false = self.sizes[look, which] > self.region(look, which).limits(level)
        return float(self.weights[which[false]].sum())


def _rates(
    simulated: Sequence[Sequences], look: int, errors: Sequence[NDArray[np.int64]], level: float
) -> Array:
    """The rate of each kind of sequences at a look with this level."""
    pairs = zip(simulated, errors, strict=True)
    return np.array([one.rate(look, own, level) for one, own in pairs])


@dataclass(frozen=True)
class _Part:
    """A part of the sequences, drawn so that errors at ``look`` are frequent in it.

    Up to this look, trainings of the first scene vary ``first`` times as much around their mean,
    and those of the others ``rest`` times; the mean has a ``drift``.
    """

    look: int = 0
    first: float = 1.0
    rest: float = 1.0
    drift: float = 0.0


def _parts(scenes: int, looks: tuple[int, ...]) -> list[_Part]:
    """Parts for some of the looks: drifting means, and trainings alike by a chance in `ALIKE`."""
    parts = [_Part()] * PLAIN
    places = range(len(looks) - 1, -1, -max(1, len(looks) // MOST_LOOKS))
    for look in places:
        parts.append(_Part(look, drift=DRIFT))
        for chance in ALIKE:
            first = chance ** (1 / (looks[look] - 1))
            parts.append(_Part(look, first, 1.0, DRIFT))
            if scenes > 1:
                own = chance ** (1 / (looks[look] - 1) / scenes)
                parts.append(_Part(look, own, own, DRIFT))
    return parts


@cache
def simulate_looks(
    scenes: int, looks: tuple[int, ...], draws: int, noise: float = 1.0, seed: int = 0
) -> Sequences:
    """Sequences in which the first of ``scenes`` is ``noise`` times as noisy as the others.

    Errors are frequent in parts of them, and weights undo that (importance sampling). The drift of
    a scene is proportional to its noise, so that weights follow from the sum over scenes alone.
    """
    rng = np.random.default_rng(seed)
    deviations = np.where(np.arange(scenes) == 0, noise, 1.0)
    deviations /= math.sqrt((deviations**2).sum())
    parts, seeds = _parts(scenes, looks), np.array(looks)[:, None]
    drawn = [_draw(rng, part, looks, deviations, -(-draws // len(parts))) for part in parts]
    totals, squares = (np.concatenate(own, axis=1)[:, :draws] for own in zip(*drawn, strict=True))
    sums = totals @ deviations / np.sqrt(seeds)
    weights = np.zeros(draws)
    for part in parts:
        number, spread = looks[part.look] - 1, 1 + part.drift**2
        logs = (1 - 1 / spread) * sums[part.look] ** 2 / 2 - math.log(spread) / 2
        first, rest = squares[part.look, :, 0], squares[part.look, :, 1:].sum(axis=1)
        for square, count, scale in (
            (first, number, part.first),
            (rest, number * (scenes - 1), part.rest),
        ):
            logs = logs + (1 - 1 / scale**2) * square / 2 - count * math.log(scale)
        weights += np.exp(logs)
    variances = squares * deviations**2 / (seeds - 1)[..., None]
    sizes = np.abs(sums) / np.sqrt(variances.sum(axis=2))
    return Sequences(scenes, looks, sizes, evenness(variances), len(parts) / weights / draws)


def _draw(
    rng: np.random.Generator, part: _Part, looks: tuple[int, ...], deviations: Array, draws: int
) -> tuple[Array, Array]:
    """Each scene's sums, and sums of squares about the mean, up to each look [L, D, S].

    They are in units of the scene's deviation; ``deviations`` are shares of that of the sum.
    """
    scenes, until = len(deviations), looks[part.look]
    new = np.diff(looks, prepend=0)[:, None, None]
    added = rng.standard_normal((len(looks), draws, scenes)) * np.sqrt(new)
    within = np.zeros_like(added)
    for place in np.flatnonzero(new > 1):
        within[place] = rng.chisquare(new[place] - 1, added[place].shape)
    scale = np.where(np.arange(scenes) == 0, part.first, part.rest)
    early = slice(part.look + 1)
    # of the early trainings: their mean does not depend on how alike they are
    mean = part.drift * rng.standard_normal((draws, 1)) * deviations
    mean = (mean + rng.standard_normal((draws, scenes))) / math.sqrt(until)
    mean -= scale * added[early].sum(axis=0) / until
    added[early] = scale * added[early] + new[early] * mean
    within[early] *= scale**2
    totals = added.cumsum(axis=0)
    squares = (added**2 / new + within).cumsum(axis=0) - totals**2 / np.array(looks)[:, None, None]
    return totals, np.maximum(squares, np.finfo(float).tiny)
