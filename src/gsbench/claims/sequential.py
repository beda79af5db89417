"""Stop when decided: seeds are added in planned looks, and a verdict at any of them may be final.

A group-sequential design for paired differences whose variance is not known. At each look the mean difference gets a
repeated confidence interval (Jennison and Turnbull 1989, *J. R. Statist. Soc. B* 51, 305): all intervals of the design
hold the true mean together with probability 1 - alpha, so whichever look one stops at, the chance of a false verdict is
at most alpha. How much of alpha each look may use is fixed beforehand by a spending function (Lan and DeMets 1983,
*Biometrika* 70, 659), here ``alpha t^1.5`` over the share t of seeds (Kim and DeMets 1987, *Biometrika* 74, 149).

Units are few, so the bounds are those of the joint distribution of Student's t at the looks (Jennison and Turnbull
1991, *Biometrika* 78, 133), not of the normal. That distribution hangs on the numbers of scenes and seeds alone, so it
is drawn (as by Shao and Feng 2007, *Contemp. Clin. Trials* 28, 563) once, from a fixed seed. Units are pairs of trials;
from ``MIN_SCENES`` scenes on they are scenes, whose means over seeds move at each look.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gsbench.analysis.statistics import ALPHA, MIN_SCENES, Interval
from gsbench.errors import InputError

FIRST_LOOK = 2  # seeds: one training of each arm says nothing of how trainings differ
EACH_UP_TO = 12  # seeds up to which every seed is a look; beyond, a look costs little patience and a bound's precision
MOST_OF_FIXED = 1.3  # the most seeds, of what a fixed design with the same power has
SPENDING_POWER = 1.5
MOST_ALPHA = 0.2  # twice it is spent on an interval of equivalence
DRAWS = 400_000

Outcome = Literal["for", "against", "equivalent", "undecided", "open"]
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Design:
    """Design of a sequential test: its looks, and the chance of a false verdict over all of them.

    ``looks`` are numbers of seeds of each scene, rising; after the last one the design ends. Where a statement about
    ``scenes`` like these can be made, scenes are the units.
    """

    scenes: int
    looks: tuple[int, ...]
    alpha: float = ALPHA

    def __post_init__(self) -> None:
        rising = all(one < other for one, other in zip(self.looks, self.looks[1:], strict=False))
        if self.scenes < 1 or not self.looks or self.looks[0] < FIRST_LOOK or not rising:
            raise InputError(
                f"looks must be rising numbers of seeds from {FIRST_LOOK} on, of at least one scene, got "
                f"{list(self.looks)} for {self.scenes}"
            )
        if not 0 < self.alpha <= MOST_ALPHA:
            raise InputError(f"an error rate must be above 0 and at most {MOST_ALPHA}, got {self.alpha}")

    @property
    def by_scene(self) -> bool:
        """Return whether scenes are the units, not pairs of trials."""
        return self.scenes >= MIN_SCENES

    def bounds(self) -> tuple[float, ...]:
        """Student's |t| at each look beyond which zero lies outside the repeated interval of level 1 - alpha."""
        return t_bounds(self.scenes, self.looks, self.alpha)

    def equivalence_bounds(self) -> tuple[float, ...]:
        """The bounds of the interval that must lie within the least effect: each of its two ends errs by alpha.

        Two one-sided tests (Schuirmann 1987, *J. Pharmacokinet. Biopharm.* 15, 657): only one of them can be false.
        """
        return t_bounds(self.scenes, self.looks, 2 * self.alpha)


@dataclass(frozen=True)
class Decision:
    """State of "the difference has this sign, and is at least ``least``" after the looks so far.

    ``outcome``: for; against (it has the other sign); equivalent (it is smaller than the least that matters, whichever
    its sign); undecided after the last look; open before it. Of "there is no difference to speak of" (sign 0) only
    equivalent and against (it is larger than the least) are told. ``interval`` is the repeated interval at ``seeds``,
    None before the first look, as ``mean`` is.
    """

    outcome: Outcome
    seeds: int
    trials: int
    mean: float | None = None
    interval: Interval | None = None

    @property
    def final(self) -> bool:
        return self.outcome != "open"


def plan_looks(maximum: int) -> tuple[int, ...]:
    """The looks of a design of at most ``maximum`` seeds: each seed from the second on, later every fourth."""
    if maximum < FIRST_LOOK:
        raise InputError(f"stopping when decided needs at least {FIRST_LOOK} seeds, got {maximum}")
    early = range(FIRST_LOOK, min(maximum, EACH_UP_TO) + 1)
    return tuple(dict.fromkeys([*early, *range(EACH_UP_TO, maximum, 4), maximum]))


def most_seeds(fixed: int) -> int:
    """The most seeds of a design that is to have the power of a fixed one with ``fixed`` seeds."""
    return max(FIRST_LOOK, math.floor(MOST_OF_FIXED * fixed))


def decide(differences: Sequence[Array], design: Design, least: float, sign: int = 1) -> Decision:
    """Go through the looks that the data suffice for, and stop at the first that decides.

    ``differences`` has for each scene the mean difference of every pair of trials, in the order of seeds; a look is
    taken once all scenes have its seeds. ``sign`` is that of the claimed difference, 0 where the claim is that there is
    none; ``least`` the smallest that matters (above 0). What lies beyond the deciding look changes nothing.
    """
    if len(differences) != design.scenes:
        raise InputError(f"the design is for {design.scenes} scenes, got differences of {len(differences)}")
    if not least > 0:
        raise InputError(f"the least effect that matters must be above 0, got {least}")
    at_hand = min(len(values) for values in differences)
    decision = Decision("open", 0, 0)
    for seeds, bound, narrow in zip(design.looks, design.bounds(), design.equivalence_bounds(), strict=True):
        if seeds > at_hand:
            return decision
        first = np.array([values[:seeds] for values in differences], dtype=float)  # [S, seeds]
        units = first.mean(axis=1) if design.by_scene else first.ravel()  # [n]
        mean = float(units.mean())
        error = float(units.std(ddof=1)) / math.sqrt(len(units)) if len(units) > 1 else math.inf
        outcome = _outcome(mean, sign, error, bound, narrow, least)
        if outcome == "open" and seeds == design.looks[-1]:
            outcome = "undecided"
        half = bound * error if error > 0 else 0.0
        decision = Decision(outcome, seeds, 2 * design.scenes * seeds, mean, Interval(mean - half, mean + half))
        if decision.final:
            return decision
    return decision


def _outcome(mean: float, sign: int, error: float, bound: float, narrow: float, least: float) -> Outcome:
    """The verdict on a mean with its standard error; one that is too small to matter is so even where it is sure.

    A standard error of zero is that of trials which differ in nothing, as counts under one hard cap.
    """
    if abs(mean) + (narrow * error if error else 0.0) < least:
        return "equivalent"
    if abs(mean) - (bound * error if error else 0.0) <= (0.0 if sign else least):
        return "open"
    return "for" if sign * mean > 0 else "against"


def spending(share: float, alpha: float) -> float:
    """The part of ``alpha`` that may be used once ``share`` of the seeds are there."""
    return float(alpha * share**SPENDING_POWER)


@cache
def t_bounds(scenes: int, looks: tuple[int, ...], alpha: float) -> tuple[float, ...]:
    """|t| at each look so that, without a difference, the chance to exceed any up to a look is what is spent by then.

    The first is Student's quantile; the others come from ``DRAWS`` sequences of t.
    """
    rng = np.random.default_rng(0)
    by_scene = scenes >= MIN_SCENES
    paths = _scene_paths if by_scene else _pair_paths
    inside = np.ones(DRAWS, dtype=bool)
    bounds: list[float] = []
    for seeds, t in zip(looks, paths(rng, scenes, looks), strict=True):
        allowed = spending(seeds / looks[-1], alpha)
        if not bounds:
            degrees = (scenes if by_scene else scenes * seeds) - 1
            bound = float(special.stdtrit(degrees, 1 - allowed / 2))
        else:
            more = round(allowed * DRAWS) - np.count_nonzero(~inside)
            bound = float(np.sort(t[inside])[-more]) if more > 0 else math.inf
        inside &= t < bound
        bounds.append(bound)
    return tuple(bounds)


def _pair_paths(rng: np.random.Generator, scenes: int, looks: tuple[int, ...]) -> list[Array]:
    """|t| over all pairs of trials [DRAWS] at each look, from sums and sums of squares of normal differences."""
    total, squares = np.zeros(DRAWS), np.zeros(DRAWS)
    found: list[Array] = []
    before = 0
    for seeds in looks:
        new, count = scenes * (seeds - before), scenes * seeds
        added = rng.normal(0, math.sqrt(new), DRAWS)
        total += added
        squares += added**2 / new + (rng.chisquare(new - 1, DRAWS) if new > 1 else 0.0)
        variance = (squares - total**2 / count) / (count - 1)
        found.append(np.abs(total) / np.sqrt(count * variance))
        before = seeds
    return found


def _scene_paths(rng: np.random.Generator, scenes: int, looks: tuple[int, ...]) -> list[Array]:
    """|t| over scenes' means [DRAWS] at each look, where scenes do not differ in their effect.

    Where they do, the means at two looks are more alike and any bound is passed less often, so this is the worst case.
    """
    totals = np.zeros((DRAWS, scenes))
    found: list[Array] = []
    before = 0
    for seeds in looks:
        totals += rng.normal(0, math.sqrt(seeds - before), totals.shape)
        deviation = totals.std(axis=1, ddof=1)
        found.append(np.abs(totals.mean(axis=1)) * math.sqrt(scenes) / deviation)
        before = seeds
    return found
