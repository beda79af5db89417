"""False verdicts from what people do, at the levels that gsbench gives to their commands.

An idea without an effect is tried in command after command until one verdict calls it better. A
habit says what the next command changes: a setting, the code, the metric, seeds, scenes. The level
of each command is `gsbench.analysis.questions.level_of`, its number n `count_tries`; its test is
that of `gsbench.analysis.statistics.t_test`, of many draws at once. Noise is normal.

A rate "better" counts the draws in which any verdict says better, "either" those in which any says
better or worse.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.questions import count_tries, level_of, look_shares
from gsbench.analysis.statistics import Region, evenness

Array = NDArray[np.float64]
Rates = tuple[Array, Array]  # of each draw: whether it was ever called better, and either

TRIES = 12  # commands about one idea
MOST_SEEDS, MOST_SCENES = 12, 9


def p_values(differences: Array) -> tuple[Array, Array]:
    """The mean [D] and the two-sided p [D] of paired differences [D, S, K] of D draws."""
    scenes, seeds = differences.shape[1:]
    variances = differences.var(axis=2, ddof=1)  # [D, S]
    means = differences.mean(axis=(1, 2))
    errors = np.sqrt(variances.sum(axis=1) / seeds) / scenes
    return means, Region(scenes, seeds, evenness(variances)).p_values(np.abs(means) / errors)


@dataclass
class Search:
    """The commands about one idea in ``draws`` independent laboratories.

    Each holds the noise of the baseline and of the idea [D, S, K], of which a command uses the
    first scenes and seeds. ``active`` are the laboratories that go on.
    """

    rng: np.random.Generator
    draws: int
    scenes: int
    seeds: int
    correlation: float = 0.0  # of the noise of a try with that of the try before
    earlier: list[set[tuple[str, int]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.shape = (self.draws, MOST_SCENES, MOST_SEEDS)
        self.baseline = self.rng.standard_normal(self.shape)
        self.idea = self.rng.standard_normal(self.shape)
        self.better = np.zeros(self.draws, bool)
        self.worse = np.zeros(self.draws, bool)
        self.active = np.ones(self.draws, bool)

    def change(self, which: Array | None = None) -> None:
        """Another setting or other code of the idea, in all laboratories or in some."""
        noise = self.rng.standard_normal(self.shape)
        changed = self.correlation * self.idea + math.sqrt(1 - self.correlation**2) * noise
        some = np.ones(self.draws, bool) if which is None else which
        self.idea = np.where(some[:, None, None], changed, self.idea)

    def command(self, shares: Sequence[float] = (1.0,)) -> tuple[Array, Array]:
        """Judge a command on the first scenes and seeds; returns means and p of its last look."""
        places = {(f"scene{s}", k) for s in range(self.scenes) for k in range(self.seeds)}
        level = level_of(count_tries(places, self.earlier))
        self.earlier.append(places)
        undecided = self.active & ~self.better
        for look, share in enumerate(shares):
            seeds = self.seeds - len(shares) + 1 + look
            own = (self.idea - self.baseline)[:, : self.scenes, :seeds]
            means, p = p_values(own)
            significant = undecided & (p < share * level)
            self.better |= significant & (means > 0)
            self.worse |= significant & (means < 0)
            undecided &= ~significant
        return means, p

    @property
    def rates(self) -> Rates:
        return self.better.astype(float), (self.better | self.worse).astype(float)


Habit = Callable[[np.random.Generator, int], Rates]


def settings(scenes: int, correlation: float = 0.0, tries: int = TRIES, seeds: int = 3) -> Habit:
    """Try settings, or edit the code, one after another, on the same seeds."""

    def habit(rng: np.random.Generator, draws: int) -> Rates:
        search = Search(rng, draws, scenes, seeds, correlation)
        for _ in range(tries):
            search.command()
            search.change()
        return search.rates

    return habit


# When the next command adds: by the mean and the p so far.
WHEN: dict[str, Callable[[Array, Array], Array]] = {
    "always": lambda means, p: np.ones(len(p), bool),
    "while the mean is above 0": lambda means, p: means > 0,
    "while p is below .2": lambda means, p: p < 0.2,
    "while p is above .05": lambda means, p: p > 0.05,
    "while the mean is below 0": lambda means, p: means < 0,
}


def adding(what: str, when: str, step: int = 1) -> Habit:
    """Add ``what`` ("seeds" or "scenes") until it pleases; all trials are kept."""

    def habit(rng: np.random.Generator, draws: int) -> Rates:
        search = Search(rng, draws, *((1, 2) if what == "seeds" else (1, 3)))
        most = MOST_SEEDS if what == "seeds" else MOST_SCENES
        while True:
            means, p = search.command()
            search.active &= WHEN[when](means, p)
            if getattr(search, what) + step > most:
                return search.rates
            setattr(search, what, getattr(search, what) + step)

    return habit


def mixed(rng: np.random.Generator, draws: int) -> Rates:
    """Add a seed where the mean is above 0, else edit the code; every third time add a scene."""
    search = Search(rng, draws, 1, 2, 0.8)
    for number in range(9):
        means, _ = search.command()
        search.change(means < 0)
        if number % 3 == 2:
            search.scenes += 1
        else:
            search.seeds += 1
    return search.rates


def metrics(rng: np.random.Generator, draws: int) -> Rates:
    """Ask in four metrics one after another, whose noise correlates by .8, of the same trials."""
    search = Search(rng, draws, 3, 3)
    own = [0.8 * search.idea + 0.6 * rng.standard_normal(search.shape) for _ in range(4)]
    for noise in own:
        search.idea = noise
        search.command()
    return search.rates


def partial(rng: np.random.Generator, draws: int) -> Rates:
    """Stop a sweep after its first seed where it looks bad, edit, and start again.

    A stopped sweep has no verdict; its command counts, since a trial of it gave a result.
    """
    search = Search(rng, draws, 3, 3, 0.8)
    for _ in range(TRIES):
        first = (search.idea - search.baseline)[:, :3, 0].mean(axis=1)
        going = search.active.copy()
        search.active &= first > 0
        search.command()
        search.active = going
        search.change()
    return search.rates


def in_looks(seeds: int, scenes: int = 1) -> Habit:
    """One question with a look at each number of seeds from two on."""

    def habit(rng: np.random.Generator, draws: int) -> Rates:
        search = Search(rng, draws, scenes, seeds)
        search.command(look_shares(seeds - 1))
        return search.rates

    return habit


def new_seeds(rng: np.random.Generator, draws: int) -> Rates:
    """Twelve commands on new seeds each: every one has the whole level, as the page says."""
    search = Search(rng, draws, 3, 3)
    for _ in range(TRIES):
        search.earlier = []
        search.command()
        search.baseline = rng.standard_normal(search.shape)
        search.change()
    return search.rates


def other_names(correlation: float, tries: int = 40) -> Habit:
    """Forty ideas under names of their own on one scene, each with the whole level."""

    def habit(rng: np.random.Generator, draws: int) -> Rates:
        search = Search(rng, draws, 1, 3, correlation)
        for _ in range(tries):
            search.earlier = []
            search.command()
            search.change()
        return search.rates

    return habit


def chosen_beginning(rng: np.random.Generator, draws: int) -> Rates:
    """Train the idea on as many of a baseline's twelve seen seeds as flatter it most.

    The seeds are the first ones without a gap, 3 to 12; the number is chosen where the baseline's
    mean lies the most standard errors below its mean over all twelve.
    """
    search = Search(rng, draws, 1, 3)
    seen = search.baseline[:, 0]
    counts = range(3, MOST_SEEDS + 1)
    below = np.stack([(seen.mean(axis=1) - seen[:, :k].mean(axis=1)) * k**0.5 for k in counts])
    best = below.argmax(axis=0) + 3
    better, either = np.zeros(draws), np.zeros(draws)
    for count in counts:
        search.seeds, search.earlier = count, []
        own = best == count
        search.active, search.better, search.worse = own, np.zeros_like(own), np.zeros_like(own)
        search.command()
        better += search.better
        either += search.better | search.worse
    return better, either


def rate(habit: Habit, draws: int, seed: int = 0, which: int = 0) -> tuple[float, float]:
    """The rate of "better" (``which`` 0) or "either" (1), and its standard error."""
    found: list[Array] = []
    rng, left = np.random.default_rng(seed), draws
    while left > 0:
        count = min(left, 4000)
        found.append(habit(rng, count)[which])
        left -= count
    every = np.concatenate(found)
    mean = float(every.mean())
    return mean, math.sqrt(max(mean * (1 - mean), 1 / len(every)) / len(every))
