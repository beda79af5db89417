"""Shapley shares against their definition over all orders, and a known game."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsbench.renders.translate import Run, shapley

NAMES = tuple("ABCD")


def subsets(switches: tuple[str, ...]) -> list[Run]:
    return [frozenset(c) for size in range(len(switches) + 1) for c in itertools.combinations(switches, size)]


def by_orders(switches: tuple[str, ...], values: dict[Run, float]) -> dict[str, float]:
    """The definition: what each adds when its turn comes, averaged over all orders."""
    totals = dict.fromkeys(switches, 0.0)
    orders = list(itertools.permutations(switches))
    for order in orders:
        for place, name in enumerate(order):
            totals[name] += values[frozenset(order[: place + 1])] - values[frozenset(order[:place])]
    return {name: total / len(orders) for name, total in totals.items()}


@given(st.lists(st.floats(-10, 10), min_size=16, max_size=16))
def test_shares_are_those_of_the_definition_and_add_up(numbers: list[float]) -> None:
    switches = NAMES
    values = dict(zip(subsets(switches), numbers, strict=True))
    shares = shapley(switches, values)
    assert shares == pytest.approx(by_orders(switches, values), abs=1e-9)
    assert sum(shares.values()) == pytest.approx(values[frozenset(switches)] - values[frozenset()], abs=1e-9)


def test_the_glove_game() -> None:
    """Two left gloves and a right one: the right one gets two thirds (Shapley's own kind of example)."""
    values = {run: float("R" in run and bool(run & {"L", "M"})) for run in subsets(("L", "M", "R"))}
    assert shapley(("L", "M", "R"), values) == pytest.approx({"L": 1 / 6, "M": 1 / 6, "R": 2 / 3})
