"""A training that does not fit says so before it starts, and when it happens."""

from __future__ import annotations

import pytest
import torch

from gsbench.errors import TrainingError
from gsbench.gaussians.model import NUM_SH_REST
from gsbench.raster.triton.launch import render_bytes
from gsbench.train.device import (
    BYTES_OF_MODEL,
    BYTES_OF_PIXEL,
    BYTES_OF_WORK,
    INITIAL,
    TRAINED,
    explain_full,
    free_bytes,
    room_for_images,
    training_bytes,
)
from tests.gaussians.helpers import random_gaussians

GB = 10**9
PIXELS = 1600 * 1060


def test_the_bytes_of_a_model_are_those_of_its_tensors() -> None:
    gaussians = random_gaussians(10, seed=0, dtype=torch.float32)
    numbers = sum(tensor.numel() for tensor in gaussians.tensors().values())
    assert numbers == 10 * (3 + 3 + 4 + 1 + 3 + 3 * NUM_SH_REST)
    assert 4 * 4 * numbers == 10 * BYTES_OF_MODEL  # float32; with gradient and two moments


def test_room(caplog: pytest.LogCaptureFixture) -> None:
    assert free_bytes(torch.device("cpu")) is None
    assert room_for_images(None, 10**9, None, PIXELS) is None
    room = room_for_images(24 * GB, 100_000, 3_400_000, PIXELS)
    assert room == 24 * GB - training_bytes(3_400_000, PIXELS)
    assert 10 * GB < room < 20 * GB
    assert caplog.text == ""

    assert room_for_images(4 * GB, 100_000, 3_400_000, PIXELS) == 0
    assert "3,400,000 Gaussians that densify.max_gaussians allows" in caplog.text
    assert "4 GB are free" in caplog.text
    with pytest.raises(TrainingError, match=r"1,000,000 initial Gaussians need about .* 1 GB are free: lower"):
        room_for_images(GB, 1_000_000, None, PIXELS)


def test_a_beginning_needs_more_lists_than_a_trained_model() -> None:
    """Counted by the kernels on the scenes of ``gsbench bench``, a million Gaussians at 1600x1060 px."""
    for crowding, pairs, units in ((INITIAL, 18_729_801, 5_110_000), (TRAINED, 3_987_093, 2_100_000)):
        counted = render_bytes(10**6, units, pairs, PIXELS // 128)
        model = 10**6 * (BYTES_OF_MODEL + BYTES_OF_WORK) + PIXELS * BYTES_OF_PIXEL
        assert training_bytes(10**6, PIXELS, crowding) == pytest.approx(model + counted, rel=0.1)
        assert training_bytes(10**6, PIXELS, crowding) >= model + counted
    assert 2000 < render_bytes(10**6, 5_110_000, 18_729_801, PIXELS // 128) / 10**6 < 2450  # bytes a Gaussian
    with pytest.raises(TrainingError, match="initial Gaussians need about"):
        room_for_images(training_bytes(10**6, PIXELS), 10**6, None, PIXELS)  # enough for one that is trained


def test_the_words_when_it_happens() -> None:
    text = str(explain_full(70, 1_234_567, torch.device("cuda:1"), "the last good state is X"))
    assert "iteration 70: cuda:1 has no memory left at 1,234,567 Gaussians; the last good state is X; lower" in text
    assert "\n" not in text
