"""Shares of ingredients in a gain: every combination of named switches, and each switch's share of the whole gain.

Each switch is off or on; a run is a set of switches that are on. The gain of a set is its value minus that of the empty
set. Shapley's value (1953) shares the gain of the full set among the switches: the mean, over all orders of turning
them on, of what each adds when its turn comes. The shares add up to the gain exactly, and interactions are split evenly
among those that have them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.statistics import ALPHA, Interval, Run, shapley, student
from gsbench.errors import InputError
from gsbench.words import closest

MAX_SWITCHES = 8

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Share:
    """Mean gain from a switch over all orders of turning switches on; ``part`` is that of the whole gain.

    ``interval`` is adjusted for the number of switches. ``alone`` is what the switch adds to nothing, ``last`` what it
    adds to all others. ``part`` is None where the gain's interval holds zero, since a part of nothing means nothing.
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


def plan_runs(switches: Sequence[str]) -> list[Run]:
    """All sets of switches; raises InputError for too many switches or one that stands twice."""
    if len(set(switches)) < len(switches) or not switches:
        raise InputError(f"switches must be different names, got {', '.join(switches) or 'none'}")
    if len(switches) > MAX_SWITCHES:
        raise InputError(f"{len(switches)} switches make {2 ** len(switches)} runs: choose at most {MAX_SWITCHES}")
    sizes = range(len(switches) + 1)
    return [frozenset(chosen) for size in sizes for chosen in itertools.combinations(sorted(switches), size)]


def ablate(switches: Sequence[str], results: Mapping[Run, Array]) -> Ablation:
    """The shares from trials: for each run of `plan_runs` its values [S, K], by scene and seed, in one order for all.

    Shares are linear in the values, so each scene and seed has its own, and intervals are those of every difference
    here (`analysis.statistics.student`). Raises InputError for missing runs and values.
    """
    _check_runs(switches, results)
    every, none = frozenset(switches), frozenset[str]()
    shape = results[none].shape
    flat = {run: values.ravel() for run, values in results.items()}
    by_trial = [
        shapley(switches, {run: float(values[k]) for run, values in flat.items()}) for k in range(flat[none].size)
    ]
    gains = results[every] - results[none]  # [S, K]
    whole = _interval(gains, ALPHA)
    sure = whole is not None and whole.excludes_zero()
    shares = []
    for switch in switches:
        own = np.array([shares_of[switch] for shares_of in by_trial]).reshape(shape)
        one, rest = frozenset((switch,)), every - {switch}
        shares.append(
            Share(
                switch,
                float(own.mean()),
                _interval(own, ALPHA / len(switches)),
                float((results[one] - results[none]).mean()),
                float((results[every] - results[rest]).mean()),
                float(own.mean() / gains.mean()) if sure else None,
            )
        )
    return Ablation(tuple(shares), float(gains.mean()), whole)


def _interval(values: Array, alpha: float) -> Interval | None:
    test = student(values)
    return None if test is None else test.interval(alpha)


def _check_runs(switches: Sequence[str], results: Mapping[Run, Array]) -> None:
    for run in results:
        for name in sorted(run - set(switches)):
            raise InputError(f"{name!r} is none of the switches{closest(name, switches)} ({', '.join(switches)})")
    if missing := [run for run in plan_runs(switches) if run not in results]:
        raise InputError(f"the run with {', '.join(sorted(missing[0])) or 'no switch'} on is missing")
    if len({values.shape for values in results.values()}) > 1 or not all(values.size for values in results.values()):
        raise InputError("every run needs the same scenes and seeds: some run lacks trials that another has")
    if not all(math.isfinite(value) for values in results.values() for value in values.ravel()):
        raise InputError("every value of a run must be a finite number")
