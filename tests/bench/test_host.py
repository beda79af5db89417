"""The host's part of a training step with Triton: how many launches and operations it makes."""

import json

import pytest

pytest.importorskip("triton")

from gsbench.bench.host import WAYS, count_step
from gsbench.verbs.machine import bench

LIMITS = {"autograd": (17, 120), "direct": (17, 88), "recorded": (0, 16)}


@pytest.mark.parametrize("way", WAYS)
def test_a_step_makes_no_more_launches_and_operations_than_before(way):
    launches, operations = count_step(way)
    most_launches, most_operations = LIMITS[way]
    assert launches == most_launches
    assert 5 < operations <= most_operations


def test_the_bench_shows_all_ways(capsys):
    assert bench(["--host", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["way"] for row in rows] == list(WAYS)
    assert all(row["host_ms"] > 0 for row in rows)
