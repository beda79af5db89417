"""Shares of ingredients in a gain: factorial designs over named switches, and each switch's share of the whole gain.

Each switch is off or on; a run is a set of switches that are on. The gain of a set is its value minus that of the empty
set. Shapley's value (1953) shares the gain of the full set among the switches: the mean, over all orders of turning
them on, of what each adds when its turn comes. The shares add up to the gain exactly, and interactions are split evenly
among those that have them.

Without all 2^n sets, a fractional design of resolution V (Box, Hunter and Hunter 2005, *Statistics for Experimenters*,
chapter 6) estimates every main effect and every pair's interaction; with three and more switches together taken to be
nothing, those fix the Shapley shares.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.shares import Run, shapley
from gsbench.analysis.statistics import Interval, t_interval
from gsbench.errors import InputError
from gsbench.words import closest

MAX_SWITCHES = 8
# Switches that are products of others, by number of switches: the smallest designs of resolution V (ibid., table 6.22).
GENERATORS = {5: ("ABCD",), 6: ("ABCDE",), 7: ("ABCDEF",), 8: ("ABCD", "ABEF")}

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Share:
    """Mean gain from a switch over all orders of turning switches on, with Student's interval; ``part`` of the whole.

    ``alone`` is what it adds to nothing, ``last`` what it adds to all others. ``part`` is None where the gain's
    interval holds zero, since a part of nothing means nothing.
    """

    switch: str
    value: float
    interval: Interval | None
    alone: float
    last: float
    part: float | None


@dataclass(frozen=True)
class Ablation:
    """The shares of all switches, and the gain of all together over none, which they add up to."""

    shares: tuple[Share, ...]
    gain: float
    interval: Interval | None


def plan_runs(switches: Sequence[str], fractional: bool = False) -> list[Run]:
    """The runs of a full factorial, or with ``fractional`` of the smallest of resolution V, none and all among them.

    Below five switches there is no such fraction. Raises InputError for too many switches or one that stands twice.
    """
    if len(set(switches)) < len(switches) or not switches:
        raise InputError(f"switches must be different names, got {', '.join(switches) or 'none'}")
    if len(switches) > MAX_SWITCHES:
        raise InputError(f"{len(switches)} switches make {2 ** len(switches)} runs: choose at most {MAX_SWITCHES}")
    generators = GENERATORS.get(len(switches), ()) if fractional else ()
    base = len(switches) - len(generators)
    runs = []
    for levels in itertools.product((-1, 1), repeat=base):
        made = [math.prod(levels["ABCDEFGH".index(letter)] for letter in word) for word in generators]
        runs.append(frozenset(name for name, level in zip(switches, (*levels, *made), strict=True) if level > 0))
    none, every = frozenset[str](), frozenset(switches)
    return list(dict.fromkeys([none, every, *sorted(runs, key=lambda run: (len(run), sorted(run)))]))


def ablate(switches: Sequence[str], results: Mapping[Run, Sequence[float]]) -> Ablation:
    """The shares from trials: for each run its values, one for each pair of scene and seed, in one order for all.

    The runs must be those of `plan_runs`. Shares are linear in the values, so each scene and seed has its own, and the
    intervals are Student's over these (None with a single one). Raises InputError for missing runs and trials.
    """
    _check_runs(switches, results)
    table = np.array([results[run] for run in results], dtype=float)  # [runs, trials]
    every, none = frozenset(switches), frozenset[str]()
    full = _full_values(switches, list(results), table)  # by run, [trials]
    trials = range(table.shape[1])
    by_trial = [shapley(switches, {run: float(values[k]) for run, values in full.items()}) for k in trials]
    gains = full[every] - full[none]  # [trials]
    whole = t_interval(gains)
    sure = whole is not None and whole.excludes_zero()
    shares = []
    for switch in switches:
        own = np.array([shares_of[switch] for shares_of in by_trial])
        one, rest = frozenset((switch,)), every - {switch}
        shares.append(
            Share(
                switch,
                float(own.mean()),
                t_interval(own),
                float((full[one] - full[none]).mean()),
                float((full[every] - full[rest]).mean()),
                float(own.mean() / gains.mean()) if sure else None,
            )
        )
    return Ablation(tuple(shares), float(gains.mean()), whole)


def _full_values(switches: Sequence[str], runs: Sequence[Run], table: Array) -> dict[Run, Array]:
    """The values of all 2^n sets: as measured, or of the model with pairs' interactions that the runs determine."""
    every = [
        frozenset(chosen) for size in range(len(switches) + 1) for chosen in itertools.combinations(switches, size)
    ]
    if set(runs) == set(every):
        return dict(zip(runs, table, strict=True))
    coefficients, _, rank, _ = np.linalg.lstsq(_model(switches, runs), table, rcond=None)  # [terms, trials]
    if rank < len(coefficients):
        raise InputError(
            f"{len(runs)} runs do not tell {len(switches)} switches and their pairs apart: take the runs of a plan"
        )
    return dict(zip(every, _model(switches, every) @ coefficients, strict=True))


def _model(switches: Sequence[str], runs: Sequence[Run]) -> Array:
    """Mean, main effects and pairs, [runs, terms], with levels of -1 and 1."""
    levels = np.array([[1.0 if name in run else -1.0 for name in switches] for run in runs])  # [runs, switches]
    pairs = [levels[:, i] * levels[:, j] for i, j in itertools.combinations(range(len(switches)), 2)]
    return np.column_stack([np.ones(len(runs)), levels, *pairs])


def _check_runs(switches: Sequence[str], results: Mapping[Run, Sequence[float]]) -> None:
    if not switches:
        raise InputError("an ablation needs at least one switch")
    for run in results:
        for name in sorted(run - set(switches)):
            raise InputError(f"{name!r} is none of the switches{closest(name, switches)} ({', '.join(switches)})")
    for needed in (frozenset[str](), frozenset(switches)):
        if needed not in results:
            raise InputError(f"the run with {'all switches on' if needed else 'no switch on'} is missing")
    counts = {len(values) for values in results.values()}
    if len(counts) > 1 or 0 in counts:
        raise InputError("every run needs the same scenes and seeds: some run lacks trials that another has")
    if not all(math.isfinite(value) for values in results.values() for value in values):
        raise InputError("every value of a run must be a finite number")
