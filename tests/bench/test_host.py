"""The host's part of a training step with Triton: how many launches and operations it makes."""

from itertools import product

import pytest

pytest.importorskip("triton")

from benchmarks import host
from benchmarks.host import MASKED, TRAININGS, WAYS, count_step

# the most operations of torch in a step of each of ``WAYS``
LIMITS = {"adc": (121, 87, 15), MASKED: (127, 93, 16), "mcmc": (168, 139, 67)}


@pytest.mark.parametrize("training", TRAININGS)
def test_a_step_makes_no_more_launches_and_operations_than_before(training):
    found = [count_step(training, way) for way in WAYS]
    assert [launches for launches, _ in found] == [17, 17, 0]
    for (_, operations), most in zip(found, LIMITS[training], strict=True):
        assert 5 < operations <= most


def test_each_training_is_timed_in_each_way(monkeypatch):
    monkeypatch.setattr(host, "STEPS", 2)
    rows = host.time_host()
    assert [(row["training"], row["way"]) for row in rows] == [*product(TRAININGS, WAYS)]
    assert all(row["host_ms"] > 0 for row in rows)
