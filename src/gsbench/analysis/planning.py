"""Numbers of scenes and seeds that a command needs to show a difference.

The commands differ in their error rate and in their looks, so the same trials have other chances.
Trainings are simulated with the shares of noise that the pilot's scenes have, and decided by the
thresholds of the judge.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gsbench.analysis.designs import (
    DESIGN_DRAWS,
    MAX_SCENES,
    MAX_SEEDS,
    POWER,
    Components,
    Design,
    designs_needed,
    power_of_mean,
)
from gsbench.analysis.questions import look_shares, plan_looks
from gsbench.analysis.statistics import ALPHA
from gsbench.analysis.thresholds import Region, evenness

COMMANDS = ("sweep", "looks", "gate", "ledger")
# seeds and scenes of designs with looks
LOOK_SEEDS, LOOK_SCENES = 12, (1, 2, 3, 4, 5, 6, 8, 10, 13)
UNSURE = 0.8  # of pilots have the real deviation within the stated range


@dataclass(frozen=True)
class Purpose:
    """The purpose of the trials.

    ``rate`` is the error rate of one question. ``looks`` says whether it is judged in looks, and
    ``give_up`` is the chance at each look that an idea with just the difference is given up. With
    ``screen``, equally many other trials come before, which must show it at this rate.
    """

    rate: float = ALPHA
    looks: bool = False
    give_up: float = 0.0
    screen: float = 0.0

    def power(self, design: Design, difference: float, noise: Components) -> float:
        """The chance that the command shows ``difference`` where pairs differ as in ``noise``."""
        deviation, shares = noise.within, noise.shares_of(design.scenes)
        if deviation == 0:
            return 1.0 if difference else 0.0
        if self.screen:
            first, then = replace(self, rate=self.screen, screen=0.0), replace(self, screen=0.0)
            return math.prod(test.power(design, difference, noise) for test in (first, then))
        if not self.looks:
            return power_of_mean(deviation, design, difference, self.rate, shares)
        shown = np.zeros(DESIGN_DRAWS, dtype=bool)
        open_ = ~shown
        size = abs(difference) / deviation
        for mean, error, region, level in _looks(design, self.rate, shares):
            reach = region.limits(level) * error
            better = open_ & (size + mean > reach)
            shown |= better
            ends = better | (size + mean < -reach)
            if self.give_up:
                ends |= mean + region.limits(2 * self.give_up) * error < 0
            open_ &= ~ends
        return float(shown.mean())

    def designs(self, difference: float, noise: Components) -> list[Design]:
        """The designs with a power of `POWER`, one per number of scenes, with the fewest seeds.

        A number of scenes is left out if it needs no fewer seeds than fewer scenes do.
        """
        chosen: list[Design] = []
        for scenes in LOOK_SCENES if self.looks else range(1, MAX_SCENES + 1):
            low, high = (
                2,
                chosen[-1].seeds - 1 if chosen else LOOK_SEEDS if self.looks else MAX_SEEDS,
            )
            if high < 2 or self.power(Design(scenes, high), difference, noise) < POWER:
                continue
            while low < high:  # the power rises with the number of seeds
                middle = (low + high) // 2
                enough = self.power(Design(scenes, middle), difference, noise) >= POWER
                low, high = (low, middle) if enough else (middle + 1, high)
            chosen.append(Design(scenes, high))
        return chosen


@dataclass(frozen=True)
class Plan:
    """The designs that show a difference between two arms, each list with the fewest trials first.

    ``like_these`` are those for scenes like these, None if the pilot has one scene. The pilot's
    ``factors`` say between which multiples of its deviation the real one lies (`UNSURE`), and
    ``powers`` the chances at these that the first design shows the difference; None without one.
    """

    components: Components
    these: tuple[Design, ...]
    like_these: tuple[Design, ...] | None
    factors: tuple[float, float]
    powers: tuple[float, float] | None

    def to_json(self) -> dict[str, Any]:
        def listed(designs: Sequence[Design]) -> list[dict[str, int]]:
            return [asdict(design) | {"trials": design.trials} for design in designs]

        like_these = None if self.like_these is None else listed(self.like_these)
        components = asdict(self.components)
        return {
            "pilot": {"pairs": components.pop("trials")} | components,
            "these_scenes": listed(self.these),
            "scenes_like_these": like_these,
            "share_of_pilots": UNSURE,
            "deviation_factors": self.factors,
            "power": self.powers,
        }


def make_plan(components: Components, difference: float, purpose: Purpose, most: int) -> Plan:
    """The plan to show ``difference``, with at most ``most`` designs for each statement."""

    def fewest(designs: Sequence[Design]) -> tuple[Design, ...]:
        return tuple(sorted(designs, key=lambda design: (design.trials, design.scenes))[:most])

    these, like_these = fewest(purpose.designs(difference, components)), None
    if components.between is not None:
        like_these = fewest(designs_needed(difference, components, like_these=True))
    low, high = deviation_range(replace(components, within=1.0))
    powers = None
    if these:
        of_first = partial(purpose.power, these[0], difference)
        ends = [replace(components, within=one * components.within) for one in (high, low)]
        powers = of_first(ends[0]), of_first(ends[1])
    factors = low, high
    return Plan(components, these, like_these, factors, powers)


def deviation_range(components: Components) -> tuple[float, float]:
    """The deviations between which that of trainings lies in `UNSURE` of such pilots."""
    degrees = components.trials - components.scenes
    tails = (1 - (1 - UNSURE) / 2, (1 - UNSURE) / 2)
    low, high = (math.sqrt(degrees / special.chdtri(degrees, 1 - tail)) for tail in tails)
    return components.within * low, components.within * high


def _looks(
    design: Design, rate: float, shares: tuple[float, ...]
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], Region, float]]:
    """Means and standard errors [DESIGN_DRAWS] at each look, thresholds, and the level."""
    looks = plan_looks(design.seeds)
    levels = [rate * share for share in look_shares(len(looks))]
    draws = np.random.default_rng(0).standard_normal((DESIGN_DRAWS, design.scenes, design.seeds))
    draws *= np.sqrt(shares)[:, None]
    for seeds, level in zip(looks, levels, strict=True):
        pairs = draws[:, :, :seeds]
        variances = pairs.var(axis=2, ddof=1)
        error = np.sqrt(variances.sum(axis=1) / seeds) / design.scenes
        yield (
            pairs.mean(axis=(1, 2)),
            error,
            Region(design.scenes, seeds, evenness(variances)),
            level,
        )
