"""Losses that arrive late from a device are the same losses, and none that is not finite gets past a checkpoint."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsbench.raster.readback import Readback
from gsbench.train.journal import LossLog


def scalars(step: int, total: float | None = None) -> tuple[Tensor, ...]:
    values = [torch.tensor(1 / (step + 1)), torch.tensor(0.5 * step), torch.tensor(0.25 * step)]
    return *values, torch.tensor(2.0 * step if total is None else total)


@pytest.fixture(params=["at once", "late"])
def late(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Readbacks as on a device that is behind: none has arrived until it is waited for."""
    if request.param == "late":
        monkeypatch.setattr(Readback, "arrived", property(lambda self: False))
    return bool(request.param == "late")


def test_the_latest_and_the_mean(late: bool) -> None:
    losses = LossLog()
    assert math.isnan(losses.smoothed)
    expected = math.nan
    for step in range(1, 25):
        losses.add(step, *scalars(step))
        value = scalars(step)[0].item()
        expected = value if math.isnan(expected) else 0.9 * expected + (1 - 0.9) * value
        if step % 10 == 0:
            record = losses.settle()
            assert record == {"step": step, "loss": value, "l1": 0.5 * step, "ssim": 0.25 * step}
            assert losses.smoothed == expected
    losses.settle()
    assert losses.smoothed == expected


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_the_first_iteration_that_was_not_finite_is_named(late: bool, bad: float) -> None:
    losses = LossLog()
    losses.add(1, *scalars(1))
    with pytest.raises(FloatingPointError, match=f"the loss became {bad} at iteration 2"):  # noqa: PT012
        losses.add(2, *scalars(2, bad))
        assert late
        losses.add(3, *scalars(3, bad))
        losses.settle()


def test_regularisers_of_another_type_and_graphs_are_taken() -> None:
    losses = LossLog()
    leaf = torch.ones((), requires_grad=True)
    losses.add(1, leaf * 2, torch.tensor(0.5), torch.tensor(0.25), (leaf * 3).double())
    assert losses.settle() == {"step": 1, "loss": 2.0, "l1": 0.5, "ssim": 0.25}
