"""Sharing a difference among the switches that make it, by Shapley's value (1953).

Each switch is off or on; the share of one is the mean, over all orders of turning them on, of what it adds when its
turn comes. The shares add up to the whole difference, and interactions are split evenly among those that have them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

Run = frozenset[str]  # the switches that are on


def shapley(switches: Sequence[str], values: Mapping[Run, float]) -> dict[str, float]:
    """The share of each switch in ``values[all] - values[none]``, from the values of all 2^n sets."""
    count, shares = len(switches), {}
    for switch in switches:
        others = [name for name in switches if name != switch]
        total = 0.0
        for size in range(count):
            weight = 1 / (count * math.comb(count - 1, size))
            for chosen in itertools.combinations(others, size):
                total += weight * (values[frozenset((*chosen, switch))] - values[frozenset(chosen)])
        shares[switch] = total
    return shares
