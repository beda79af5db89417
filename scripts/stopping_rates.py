"""Error rates and savings of stopping when decided, from simulated sweeps, for the tables of docs/verdict.md.

    python scripts/stopping_rates.py                write the tables into the page (about five minutes)
    python scripts/stopping_rates.py --sweeps 200   print them from fewer sweeps

Differences are in deviations of a pair of trials; the least effect that matters is the one that the fixed design sees
in 80 % of sweeps. The same numbers come out at every call.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import special

from gsbench.analysis.power import POWER, t_power
from gsbench.analysis.statistics import ALPHA, MIN_SCENES
from gsbench.claims.sequential import Decision, Design, decide, most_seeds, plan_looks

PAGE = Path(__file__).parents[1] / "docs" / "verdict.md"
SECTION = re.compile(r"(<!-- stopping: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
SWEEPS = 4000
SCENE_DEVIATION = 0.5  # of the effect between scenes, where scenes are the units
METRICS, CORRELATION = 6, 0.7

Array = NDArray[np.float64]
Noise = Callable[[np.random.Generator, int, int], Array]  # (rng, scenes, seeds) -> differences of mean zero


@dataclass(frozen=True)
class Size:
    """A fixed design of ``scenes`` and ``fixed`` seeds, and the one that may stop before ``most``."""

    scenes: int
    fixed: int

    @property
    def most(self) -> int:
        return most_seeds(self.fixed)

    @property
    def design(self) -> Design:
        return Design(self.scenes, plan_looks(self.most))

    def units(self, differences: Array) -> Array:
        """The values that the fixed design tests, from [scenes, seeds]: the pairs, or the scenes' means."""
        own = differences[:, : self.fixed]
        return own.mean(axis=1) if self.design.by_scene else own.ravel()

    def least(self) -> float:
        """The effect that the fixed design's t test sees with 80 % power, found by halving."""
        units = self.scenes if self.design.by_scene else self.scenes * self.fixed
        spread = math.hypot(SCENE_DEVIATION, 1 / math.sqrt(self.fixed)) if self.design.by_scene else 1.0
        low, high = 0.0, 10.0
        while high - low > 1e-9:
            middle = (low + high) / 2
            seen = t_power(middle, spread / math.sqrt(units), units - 1)
            low, high = (low, middle) if seen >= POWER else (middle, high)
        return high


def normal(rng: np.random.Generator, scenes: int, seeds: int) -> Array:
    """Normal; where scenes are the units, each has an effect of its own besides."""
    values = rng.normal(0, 1, (scenes, seeds))
    return values + rng.normal(0, SCENE_DEVIATION, (scenes, 1)) if scenes >= MIN_SCENES else values


def heavy(rng: np.random.Generator, scenes: int, seeds: int) -> Array:
    """Student's t with three degrees of freedom, of deviation one."""
    return rng.standard_t(3, (scenes, seeds)) / math.sqrt(3)


def noisy_scene(rng: np.random.Generator, scenes: int, seeds: int) -> Array:
    """The first scene is four times as noisy as the others."""
    return rng.normal(0, 1, (scenes, seeds)) * np.where(np.arange(scenes) == 0, 4.0, 1.0)[:, None]


def disagreeing(rng: np.random.Generator, scenes: int, seeds: int) -> Array:
    """Effects of scenes from -1 to 1 deviation, of mean zero."""
    return rng.normal(0, 1, (scenes, seeds)) + np.linspace(-1, 1, scenes)[:, None]


def either_fails(rng: np.random.Generator, scenes: int, seeds: int) -> Array:
    """One training in ten goes wrong, of either arm alike, and costs five deviations."""
    failed = (rng.random((2, scenes, seeds)) < 0.1) * 5.0
    return rng.normal(0, 1, (scenes, seeds)) + failed[0] - failed[1]


def one_fails(rng: np.random.Generator, scenes: int, seeds: int) -> Array:
    """One training in ten goes wrong, of one arm alone, which makes up for it in the others: skewed, of mean zero."""
    return rng.normal(0, 1, (scenes, seeds)) - (rng.random((scenes, seeds)) < 0.1) * 5.0 + 0.5


SIZES = (Size(1, 6), Size(1, 9), Size(3, 3), Size(3, 6), Size(4, 6), Size(5, 9), Size(6, 3), Size(8, 6))
NOISES: dict[str, Noise] = {
    "normal": normal,
    "heavy tails (t with 3 degrees)": heavy,
    "one scene four times as noisy": noisy_scene,
    "scenes disagree": disagreeing,
    "a training in ten fails, either arm": either_fails,
    "a training in ten fails, one arm (skewed)": one_fails,
}


def sweeps(size: Size, effect: float, count: int, noise: Noise = normal) -> list[tuple[Decision, bool]]:
    """(decision, whether the fixed design sees an effect of the same sign) of simulated sweeps."""
    rng = np.random.default_rng([size.scenes, size.fixed, round(1000 * effect)])
    least, design = size.least(), size.design
    found = []
    for _ in range(count):
        differences = effect * least + noise(rng, size.scenes, size.most)
        found.append((decide(list(differences), design, least), _fixed_sees(size.units(differences))))
    return found


def share(found: list[tuple[Decision, bool]], *outcomes: str) -> float:
    """The share of sweeps with one of the outcomes."""
    return float(np.mean([decision.outcome in outcomes for decision, _ in found]))


def savings_table(count: int) -> list[str]:
    """A design a row: errors, power beside the fixed design's, and trials as shares of the fixed design's."""
    lines = [
        "| scenes | seeds, fixed | seeds, at most | false better or worse | false “too small” | sees the least effect "
        "(fixed) | says “too small” of none | trials: none | half | least | twice | three times |",
        "|" + "---|" * 12,
    ]
    for size in SIZES:
        found = {effect: sweeps(size, effect, count) for effect in (0.0, 0.5, 1.0, 2.0, 3.0)}
        used = [
            f"{np.mean([decision.seeds for decision, _ in one]) / size.fixed:.0%}".replace("%", " %")
            for one in found.values()
        ]
        fixed = float(np.mean([seen for _, seen in found[1.0]]))
        cells = [
            str(size.scenes),
            str(size.fixed),
            str(size.most),
            _percent(share(found[0.0], "for", "against")),
            _percent(share(found[1.0], "equivalent")),
            f"{_percent(share(found[1.0], 'for'))} ({_percent(fixed)})",
            _percent(share(found[0.0], "equivalent")),
            *used,
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def errors_table(count: int) -> list[str]:
    """A kind of noise a row, four scenes and six seeds: the rates of false verdicts."""
    size = Size(4, 6)
    lines = ["| differences | false better or worse | false “too small” | fixed design | plain test at every look |"]
    lines.append("|" + "---|" * 5)
    for name, noise in NOISES.items():
        none, least = sweeps(size, 0.0, count, noise), sweeps(size, 1.0, count, noise)
        cells = [
            name,
            _percent(share(none, "for", "against")),
            _percent(share(least, "equivalent")),
            _percent(_plain(size, noise, count, (size.fixed,))),
            _percent(_plain(size, noise, count, size.design.looks)),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    for together, name in ((False, "each with the whole 5 %"), (True, "sharing 5 %")):
        rate = _percent(any_of_many(size, count, together))
        lines.append(f"| any of six claims, metrics correlated {CORRELATION}, {name} | {rate} | | | |")
    return lines


def any_of_many(size: Size, count: int, together: bool) -> float:
    """The share of sweeps without effects in which any of six correlated metrics is called better or worse."""
    rng = np.random.default_rng([size.scenes, size.fixed, METRICS])
    alpha = ALPHA / METRICS if together else ALPHA
    design, least = Design(size.scenes, size.design.looks, alpha), size.least()
    wrong = 0
    for _ in range(count):
        own = rng.normal(0, 1, (METRICS, size.scenes, size.most))
        common = rng.normal(0, 1, (size.scenes, size.most))
        values = math.sqrt(CORRELATION) * common + math.sqrt(1 - CORRELATION) * own
        wrong += any(decide(list(one), design, least).outcome in ("for", "against") for one in values)
    return wrong / count


def _plain(size: Size, noise: Noise, count: int, looks: Sequence[int]) -> float:
    """The share of sweeps without an effect in which a plain t test is below 5 % at some look."""
    rng = np.random.default_rng([size.scenes, size.fixed, 0])
    wrong = 0
    for _ in range(count):
        differences = noise(rng, size.scenes, size.most)
        wrong += any(_p(differences[:, :seeds].ravel()) < ALPHA for seeds in looks)
    return wrong / count


def _fixed_sees(units: Array) -> bool:
    return _p(units) < ALPHA and units.mean() > 0


def _p(units: Array) -> float:
    t = abs(units.mean()) / units.std(ddof=1) * math.sqrt(len(units))
    return float(2 * special.stdtr(len(units) - 1, -t))


def _percent(rate: float) -> str:
    return f"{100 * rate:.1f} %"


TABLES = {"savings": savings_table, "errors": errors_table}


def with_tables(page: str, count: int = SWEEPS) -> str:
    """The page with both tables made anew."""
    return SECTION.sub(lambda m: m[1] + "\n".join(TABLES[m[2]](count)) + "\n" + m[3], page)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sweeps", type=int, help="print the tables of so many sweeps a row, and leave the page alone")
    wanted = parser.parse_args().sweeps
    if wanted is None:
        PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    else:
        print("\n\n".join("\n".join(table(wanted)) for table in TABLES.values()))
