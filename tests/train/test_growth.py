"""Warnings about growth that feeds itself, and about a limit that stops all growth."""

import logging

import pytest

from gsbench.events import RefineEvent
from gsbench.train.records import BLOCKED_ITERATIONS, RUNAWAY_ROUNDS, GrowthWatch


def warnings(caplog, events):
    watch = GrowthWatch()
    with caplog.at_level(logging.WARNING):
        for event in events:
            watch.observe(event)
    return [record.getMessage() for record in caplog.records]


def rounds(number, **counts):
    return [RefineEvent(step=100 * k, before=10_000, **counts) for k in range(1, number + 1)]


def test_splits_that_split_again_are_named_once(caplog):
    found = warnings(caplog, rounds(3 * RUNAWAY_ROUNDS, split_volume=500, isotropic_resplit=400))
    assert len(found) == 1
    assert f"iteration {100 * RUNAWAY_ROUNDS}: in {RUNAWAY_ROUNDS} refinements" in found[0]


@pytest.mark.parametrize(
    "events",
    [
        rounds(RUNAWAY_ROUNDS - 1, split_volume=500, isotropic_resplit=400),
        rounds(50, split_volume=500, isotropic_resplit=200),  # a minority
        rounds(50, split_volume=50, isotropic_resplit=50),  # few in all
        rounds(9, split_volume=500, isotropic_resplit=400)
        + rounds(1, split_volume=500)
        + rounds(9, split_volume=500, isotropic_resplit=400),
        rounds(BLOCKED_ITERATIONS // 100 + 1, cloned=1, blocked_by_cap=5),
        rounds(9, blocked_by_cap=5) + rounds(1, cloned=5) + rounds(9, blocked_by_cap=5),
    ],
)
def test_ordinary_growth_is_not_warned_about(caplog, events):
    assert warnings(caplog, events) == []


def test_a_limit_that_blocks_for_long_is_named_once(caplog):
    events = rounds(40, cloned=1, blocked_by_cap=5)
    # an opacity reset between two rounds says nothing about growth
    events.insert(6, RefineEvent(step=650, before=10_000, opacity_reset=True))
    (found,) = warnings(caplog, events)
    assert found.startswith("iterations 100 to 1200: densify.max_gaussians refused growth")
