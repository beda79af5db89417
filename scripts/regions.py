"""Make the thresholds of the test over these scenes, src/gsbench/analysis/thresholds.npz.

    python scripts/regions.py                 make the table (about fifteen minutes, one core)
    python scripts/regions.py --scenes 3      print the sizes and powers of some numbers of scenes

With K seeds, a difference of t standard errors is significant at a level if t exceeds
``student ** (1 - f) * normal ** f``: Student's threshold with K - 1 degrees of freedom and that of
the normal distribution. The part f in 0..1 depends on how evenly scenes share the variance, y =
log(1 / largest share) / log(scenes) in 0..1. It is 0 at y = 0, where one scene has all variance, so
that the test is Student's. For each number of scenes and seeds and each level, f at the knots of y
is chosen for the greatest power, while the size is at most the level for every ratio of noise.

Given the variances, a mean is normal. So the size is the mean of 2 Φ(-c √(Σv / Σσ²)) over variances
v drawn as σ² χ²(K - 1) / (K - 1), with the threshold c for the drawn shares; small variances are
drawn more often and weighted. K - 1 degrees of freedom are valid for every ratio of noise, since
P(Z² > c² Σ λ Q) is convex in the shares λ: it is largest if one of them is 1.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

TABLE = Path(__file__).parents[1] / "src" / "gsbench" / "analysis" / "thresholds.npz"
SCENES = (2, 3, 4, 5, 6, 8, 10, 13, 17, 23, 30)
SEEDS = (2, 3, 4, 5, 6, 8)
LEVELS = (0.2, 0.05, 0.0125, 0.003, 0.0005)
KNOTS = (0.0, 0.03, 0.08, 0.16, 0.27, 0.4, 0.55, 0.75, 1.0)
RATIOS = (1.5, 2.0, 3.0, 5.0, 8.0, 13.0, 20.0, 35.0, 100.0)
DRAWS, FRESH = 8000, 32_000
ALLOWED = 1.01  # times a level is what the size may reach in fresh draws
MARGIN = 1.005  # times a level is what the size may reach in these draws
EFFECT = 1.04  # above the normal threshold: 3 standard errors at 5 %

Array = NDArray[np.float64]


def noises(scenes: int) -> Array:
    """The deviations [C, S] of scenes for which sizes are bounded; the first are equal."""
    found = [np.ones(scenes)]
    for noisy in sorted({1, 2, 3, scenes // 2, scenes - 1} & set(range(1, scenes))):
        for ratio in RATIOS:
            found.append(np.where(np.arange(scenes) < noisy, ratio, 1.0))
    if scenes > 2:
        found += [np.geomspace(ratio, 1, scenes) for ratio in (3.0, 10.0, 30.0, 100.0)]
    return np.array(found)


class Sample:
    """Draws of the variances of scenes with a kind of noise each: how even, and how large.

    ``even`` [C, D] is y, ``ratio`` [C, D] the estimated standard error over the true one,
    ``weight`` [D] the importance of a draw.
    """

    def __init__(self, deviations: Array, seeds: int, draws: int, seed: int) -> None:
        rng = np.random.default_rng([seed, seeds])
        scenes = deviations.shape[1]
        shape, factors = (seeds - 1) / 2, [(1.0, 1.0)]
        low = (0.1, 0.01, 0.001) if scenes < 6 else (0.3, 0.1)
        factors += [(one, 1.0) for one in (0.1, 0.01, 0.001)] + [(one, one) for one in low]
        parts = np.array([2.0] + [1.0] * (len(factors) - 1))
        parts /= parts.sum()
        chosen = np.repeat(np.arange(len(factors)), rng.multinomial(draws, parts))
        scale = np.ones((len(factors), scenes))
        scale[:, 0] = [first for first, _ in factors]
        scale[:, 1:] = np.array([rest for _, rest in factors])[:, None]
        drawn = rng.gamma(shape, 1, (draws, scenes))
        # The first scene's are spread evenly, since it decides if it is the noisy one.
        for part in range(len(factors)):
            own = np.flatnonzero(chosen == part)
            ranks = (rng.permutation(len(own)) + 0.5) / len(own)
            drawn[own, 0] = special.gammaincinv(shape, ranks)
        drawn *= scale[chosen]
        logs = np.array(
            [(drawn * (1 - 1 / one)).sum(axis=1) - shape * np.log(one).sum() for one in scale]
        )
        self.weight = 1 / (parts[:, None] * np.exp(logs)).sum(axis=0)
        self.weight /= draws
        drawn = drawn / shape
        true = deviations**2 / (deviations**2).sum(axis=1, keepdims=True)
        total = drawn @ true.T
        largest = np.stack([(drawn * own).max(axis=1) for own in true], axis=1)
        self.ratio = np.sqrt(total.T)
        self.even = np.clip(np.log(total / largest).T / np.log(scenes), 0, 1)


def thresholds(level: float, seeds: int) -> tuple[float, float]:
    """Student's and the normal threshold."""
    return float(special.stdtrit(seeds - 1, 1 - level / 2)), float(special.ndtri(1 - level / 2))


class Problem:
    """The choice of f at the knots for one number of scenes and seeds."""

    def __init__(self, scenes: int, seeds: int, draws: int = DRAWS, seed: int = 0) -> None:
        self.seeds = seeds
        self.sample = Sample(noises(scenes), seeds, draws, seed)
        place = np.interp(self.sample.even, KNOTS, np.arange(len(KNOTS)))
        self.index = np.minimum(place.astype(int), len(KNOTS) - 2)
        self.part = place - self.index
        count = len(self.sample.even)
        self.flat = self.index + len(KNOTS) * np.arange(count)[:, None]
        half = 1 + RATIOS.index(3.0)
        self.powered = [0, 0, 2, 4, half] if scenes > 2 else [0, 0, 2, 4]

    def limits(self, level: float, f: Array) -> Array:
        student, normal = thresholds(level, self.seeds)
        own = f[self.index] * (1 - self.part) + f[self.index + 1] * self.part
        return np.asarray(student * (normal / student) ** own)

    def _slope(self, of_limits: Array, rows: slice | list[int]) -> Array:
        """The slopes by f at the knots [C, knots], from those by log limits [C, D]."""
        count, knots = len(self.sample.even[rows]), len(KNOTS)
        flat = (self.index[rows] + knots * np.arange(count)[:, None]).ravel()
        low = np.bincount(flat, (of_limits * (1 - self.part[rows])).ravel(), count * knots + 1)
        high = np.bincount(flat + 1, (of_limits * self.part[rows]).ravel(), count * knots + 1)
        return np.asarray((low + high)[:-1].reshape(count, knots))

    def sizes(self, level: float, f: Array) -> tuple[Array, Array]:
        """The sizes [C] and their slopes by f [C, knots]."""
        student, normal = thresholds(level, self.seeds)
        reach = self.limits(level, f) * self.sample.ratio
        size = (2 * special.ndtr(-reach)) @ self.sample.weight
        density = 2 * np.exp(-(reach**2) / 2) / np.sqrt(2 * np.pi) * self.sample.weight
        return size, self._slope(density * reach * np.log(student / normal), slice(None))

    def bounds(self, level: float, most: float) -> Array:
        """The sizes [C] that may be reached in these draws: ``most`` times the level.

        Without f the test is Student's and keeps the level; what the draws have above it is theirs.
        """
        excess = self.sizes(level, np.zeros(len(KNOTS)))[0] - level
        return np.asarray(most * level + np.maximum(excess, 0))

    def power(self, level: float, f: Array) -> tuple[float, Array]:
        """The mean power for some kinds of noise, and its slope by f."""
        student, normal = thresholds(level, self.seeds)
        rows, effect = self.powered, normal + EFFECT
        reach = self.limits(level, f)[rows] * self.sample.ratio[rows]
        power = special.ndtr(effect - reach) @ self.sample.weight
        density = np.exp(-((effect - reach) ** 2) / 2) / np.sqrt(2 * np.pi) * self.sample.weight
        slope = self._slope(density * reach * np.log(student / normal), rows)
        return float(power.mean()), slope.mean(axis=0)

    def solve(self, level: float, start: Array) -> Array:
        """f at the knots."""
        free = len(KNOTS) - 1

        def whole(x: Array) -> Array:
            return np.concatenate([[0.0], x])

        rises = np.eye(free) - np.eye(free, k=-1)
        bounds = self.bounds(level, MARGIN)
        constraints = [
            {
                "type": "ineq",
                "fun": lambda x: (bounds - self.sizes(level, whole(x))[0]) / level,
                "jac": lambda x: -self.sizes(level, whole(x))[1][:, 1:] / level,
            },
            {"type": "ineq", "fun": lambda x: rises @ x, "jac": lambda _: rises},
        ]
        scale = 1 / max(self.power(level, start)[0], 1e-12)
        found = optimize.minimize(
            lambda x: -scale * self.power(level, whole(x))[0],
            start[1:],
            jac=lambda x: -scale * self.power(level, whole(x))[1][1:],
            bounds=[(0.0, 1.0)] * free,
            constraints=constraints,
            method="SLSQP",
            options={"maxiter": 40, "ftol": 1e-5},
        )
        return whole(np.maximum.accumulate(np.clip(found.x, 0, 1)))

    def fitting(self, level: float, f: Array) -> Array:
        """The largest part of f whose sizes are at most the level."""
        low, high, bounds = 0.0, 1.0, self.bounds(level, ALLOWED)
        if (self.sizes(level, f)[0] <= bounds).all():
            return f
        for _ in range(10):
            middle = (low + high) / 2
            fits = (self.sizes(level, middle * f)[0] <= bounds).all()
            low, high = (middle, high) if fits else (low, middle)
        return low * f


def columns(scenes: int, seeds: int) -> Array:
    """f at the levels and knots [L, knots]."""
    problem, fresh = Problem(scenes, seeds), Problem(scenes, seeds, FRESH, 1)
    found = np.zeros((len(LEVELS), len(KNOTS)))
    for row, near in ((1, 1), (0, 1), (2, 1), (3, 2), (4, 3)):
        level, best = LEVELS[row], -1.0
        # A search can end where it began, so there are several.
        for start in (found[near], 0.5 * np.array(KNOTS), 0.2 * np.array(KNOTS)):
            solved = problem.solve(level, start)
            if not np.isfinite(solved).all():
                continue
            fitting = fresh.fitting(level, solved)
            power = problem.power(level, fitting)[0]
            if power > best:
                best, found[row] = power, fitting
            if fitting[-1] > 0.1 and not np.array_equal(fitting, start):
                break
    return rising(found, seeds)


def rising(column: Array, seeds: int) -> Array:
    """The column [L, knots] with f lowered where a smaller level would have a lower threshold."""
    column, places = column.copy(), np.linspace(0, 1, 21)
    for row, knot in np.ndindex(len(LEVELS) - 1, len(KNOTS)):
        levels = LEVELS[row] * (LEVELS[row + 1] / LEVELS[row]) ** places
        # Those of one seed more, too: values between two numbers of seeds are interpolated.
        for own in (seeds, seeds + 1):
            logs = np.log([thresholds(float(level), own) for level in levels])
            before, wanted = column[row, knot], column[row + 1, knot]
            for share in np.linspace(1, 0, 51):
                after = min(before, wanted) + share * max(0.0, wanted - before)
                f = before + places * (after - before)
                if (np.diff((1 - f) * logs[:, 0] + f * logs[:, 1]) > 1e-4).all():
                    break
            column[row + 1, knot] = after
    return column


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, nargs="*", help="print these; the table stays")
    wanted = parser.parse_args().scenes
    table = np.zeros((len(SCENES), len(SEEDS), len(LEVELS), len(KNOTS)))
    for row, scenes in enumerate(SCENES):
        if wanted and scenes not in wanted:
            continue
        for column, seeds in enumerate(SEEDS):
            table[row, column] = columns(scenes, seeds)
            print(scenes, seeds, flush=True)
            if wanted:
                fresh = Problem(scenes, seeds, FRESH, 2)
                for level, f in zip(LEVELS, table[row, column], strict=True):
                    worst = fresh.sizes(level, f)[0].max() / level
                    power = fresh.power(level, f)[0]
                    print(scenes, seeds, level, f"{worst:.3f} {power:.3f}", f.round(3))
    if not wanted:
        names = {"scenes": SCENES, "seeds": SEEDS, "levels": LEVELS, "knots": KNOTS}
        arrays = {name: np.array(values, dtype=np.float32) for name, values in names.items()}
        np.savez_compressed(TABLE, f=np.round(table, 3).astype(np.float32), **arrays)


if __name__ == "__main__":
    main()
