"""Records of a training: losses, also of a device that is behind, volumes, and warnings of growth."""

import logging
import math

import pytest
import torch

from gsbench.events import RefineEvent
from gsbench.raster.staged import Readback
from gsbench.train.records import (
    BLOCKED_ITERATIONS,
    RUNAWAY_ROUNDS,
    GrowthWatch,
    LossLog,
    append,
    volume_histogram,
)


def scalars(step, total=None):
    return torch.tensor([1 / (step + 1), 0.5 * step, 0.25 * step, 2.0 if total is None else total])


@pytest.fixture(params=["at once", "late"])
def late(request, monkeypatch):
    """Whether the device is behind: then no readback has arrived before it is waited for."""
    if request.param == "late":
        monkeypatch.setattr(Readback, "arrived", property(lambda self: False))
    return bool(request.param == "late")


def test_the_latest_loss_and_the_smoothed_loss_are_exact(late):
    losses = LossLog()
    assert math.isnan(losses.smoothed)
    expected = math.nan
    for step in range(1, 25):
        losses.add(step, scalars(step))
        value = scalars(step)[0].item()
        expected = value if math.isnan(expected) else 0.9 * expected + (1 - 0.9) * value
        if step % 10 == 0:
            record = losses.wait()
            assert record == {"step": step, "loss": value, "l1": 0.5 * step, "ssim": 0.25 * step}
            assert losses.smoothed == expected
    losses.wait()
    assert losses.smoothed == expected


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_the_first_iteration_with_a_loss_that_is_not_finite_is_named(late, bad):
    losses = LossLog()
    losses.add(1, scalars(1))
    with pytest.raises(FloatingPointError, match=f"the loss became {bad} at iteration 2"):  # noqa: PT012
        losses.add(2, scalars(2, bad))
        assert late
        losses.add(3, scalars(3, bad))
        losses.wait()


def test_without_a_regulariser_the_loss_is_the_total(late):
    losses = LossLog()
    losses.add(1, scalars(1)[:3])
    assert losses.wait() == {"step": 1, "loss": 0.5, "l1": 0.5, "ssim": 0.25}
    with pytest.raises(FloatingPointError, match="the loss became nan at iteration 2"):  # noqa: PT012
        losses.add(2, torch.tensor([math.nan, 0.5, 0.25]))
        losses.wait()


def test_readers_see_a_record_at_once(tmp_path):
    with (tmp_path / "events.jsonl").open("a") as stream:
        append(stream, {"step": 1})
        assert (tmp_path / "events.jsonl").read_text() == '{"step": 1}\n'


def test_volumes_are_counted_in_bins_of_a_quarter_decade():
    """Volumes beyond the range count in the outermost bins."""
    log_scales = (
        torch.randn(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 4 - 4
    )
    log_scales[0], log_scales[1] = -50.0, 50.0
    counts = [0] * 84
    for scales in log_scales.exp().tolist():
        volume = math.log10(4 / 3 * math.pi * math.prod(scales))
        counts[min(max(math.floor((volume + 18) * 4), 0), 83)] += 1
    record = volume_histogram(700, log_scales)
    assert (record["step"], record["counts"]) == (700, counts)
    assert record["log10_edges"] == pytest.approx([-18 + k / 4 for k in range(85)])
    assert min(counts[0], counts[-1]) > 0


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
