"""Shapley shares against their definition over all orders, known games, and simulated trials."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsbench.analysis.statistics import Run, shapley
from gsbench.claims.ablation import ablate, plan_runs
from gsbench.errors import InputError

NAMES = tuple("ABCDEFGH")


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
    switches = NAMES[:4]
    values = dict(zip(subsets(switches), numbers, strict=True))
    shares = shapley(switches, values)
    assert shares == pytest.approx(by_orders(switches, values), abs=1e-9)
    assert sum(shares.values()) == pytest.approx(values[frozenset(switches)] - values[frozenset()], abs=1e-9)


def test_the_glove_game() -> None:
    """Two left gloves and a right one: the right one gets two thirds (Shapley's own kind of example)."""
    values = {run: float("R" in run and bool(run & {"L", "M"})) for run in subsets(("L", "M", "R"))}
    assert shapley(("L", "M", "R"), values) == pytest.approx({"L": 1 / 6, "M": 1 / 6, "R": 2 / 3})


@pytest.mark.parametrize("count", range(1, 9))
def test_plans_hold_all_combinations(count: int) -> None:
    assert set(plan_runs(NAMES[:count])) == set(subsets(NAMES[:count]))


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """Of all three shares together: intervals are adjusted for their number."""
    rng, held = np.random.default_rng(0), 0
    runs = plan_runs(("volume", "shrink", "once"))
    for _ in range(400):
        results = {run: 1.0 * ("volume" in run) + rng.normal(0, 0.3, (2, 3)) for run in runs}
        found = ablate(("volume", "shrink", "once"), results)
        intervals = [share.interval for share in found.shares]
        truths = (1.0, 0.0, 0.0)
        held += all(one is not None and one.low <= t <= one.high for one, t in zip(intervals, truths, strict=True))
    assert held / 400 > 0.95 - 3 * (0.05 * 0.95 / 400) ** 0.5


def test_a_share_is_a_part_only_of_a_sure_gain() -> None:
    runs = plan_runs(("a", "b"))
    sure = ablate(("a", "b"), {run: np.array([[len(run) + 0.01 * k for k in range(3)]]) for run in runs})
    assert [share.part for share in sure.shares] == pytest.approx([0.5, 0.5])
    assert [(share.alone, share.last) for share in sure.shares] == [pytest.approx((1, 1))] * 2
    rng = np.random.default_rng(1)
    unsure = ablate(("a", "b"), {run: rng.normal(0, 1, (1, 3)) for run in runs})
    assert [share.part for share in unsure.shares] == [None, None]
    assert ablate(("a", "b"), {run: np.array([[1.0]]) for run in runs}).interval is None


def test_what_cannot_be_shared_is_refused() -> None:
    both = np.array([[1.0, 2.0]])
    runs = dict.fromkeys(plan_runs(("a", "b")), both)
    for broken, message in (
        ({run: values for run, values in runs.items() if run}, "no switch on"),
        ({run: values for run, values in runs.items() if len(run) < 2}, "a, b on is missing"),
        (runs | {frozenset("a"): np.array([[1.0]])}, "same scenes and seeds"),
        (runs | {frozenset("a"): np.array([[1.0, float("nan")]])}, "finite"),
        (runs | {frozenset(("a", "bb")): both}, "'bb' is none of the switches"),
    ):
        with pytest.raises(InputError, match=message):
            ablate(("a", "b"), broken)
    for switches in ((), ("a", "a"), tuple("abcdefghi")):
        with pytest.raises(InputError):
            plan_runs(switches)
