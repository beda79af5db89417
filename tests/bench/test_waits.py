"""What counts as a wait for a device, and how many waits a training step has."""

import json
import os
import sys

import pytest
import torch

from benchmarks.counters import counting_waits
from gsbench.raster.staged import Readback
from tests.conftest import ROOT
from tests.processes import completed

pytestmark = pytest.mark.slow

ONE = torch.ones(4)
WAITING = {
    "a value": (lambda: ONE.sum().item(), {"_local_scalar_dense": 1}),
    "a question": (lambda: bool((ONE > 0).all()), {"_local_scalar_dense": 1}),
    "a mask": (lambda: ONE[ONE > 0], {"index": 1}),
    "a size": (lambda: ONE.nonzero(), {"nonzero": 1}),
    "numbers for a device": (lambda: torch.tensor([1.0, 2.0]), {"lift_fresh": 1}),
    "a copy to another device": (lambda: ONE.to("meta"), {"_to_copy": 1}),
}


@pytest.mark.parametrize("what", list(WAITING))
def test_operations_that_wait_are_counted(what):
    work, expected = WAITING[what]
    with counting_waits(pretend=True) as counts:
        work()
    assert counts == expected


def test_waits_in_the_backward_pass_are_counted():
    class Reads(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            return x.clone()

        @staticmethod
        def backward(ctx, g):
            return g * g.sum().item()

    leaf = torch.ones(3, requires_grad=True)
    with counting_waits() as counts:
        Reads.apply(leaf).sum().backward()
    assert counts == {"_local_scalar_dense": 1}


def test_a_readback_waits_only_if_it_has_not_arrived(monkeypatch):
    with counting_waits() as counts:
        assert Readback(ONE).values().tolist() == [1, 1, 1, 1]
    assert counts == {}
    monkeypatch.setattr(Readback, "arrived", property(lambda self: False))
    with counting_waits() as counts:
        Readback(ONE).values()
    assert counts == {"readback": 1}


@pytest.mark.parametrize("raster", ["triton", "reference"])
def test_a_training_step_with_triton_waits_once(raster):
    """It reads how much there is to composite. Its other operations are not taken for waits.

    The reference shows that more waits are counted.
    """
    pytest.importorskip("triton")
    environment = os.environ | {
        "TRITON_INTERPRET": "1",
        "PYTHONPATH": os.pathsep.join(path for path in [str(ROOT), *sys.path] if path),
    }
    command = [sys.executable, "-m", "tests.train.one_step", raster]
    done = completed(command, cwd=ROOT, env=environment)
    counts = {
        name: count for line in done.stdout.splitlines() for name, count in json.loads(line).items()
    }
    assert counts.keys() == {"adc", "absgrad", "mcmc"}
    for name, count in counts.items():
        if raster == "triton":
            assert sum(count.values()) == 1, name
        else:
            assert sum(count.values()) > 5, name
