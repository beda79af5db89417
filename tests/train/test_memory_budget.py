"""A training that does not fit says so before it starts, and when it happens."""

from __future__ import annotations

import logging

import pytest
import torch

from gsbench.errors import TrainingError
from gsbench.gaussians.model import NUM_SH_REST
from gsbench.train.memory_budget import BYTES_OF_MODEL, explain_full, free_bytes, room_for_images, training_bytes
from tests.gaussians.helpers import random_gaussians

GB = 10**9
PIXELS = 1600 * 1060


def test_the_bytes_of_a_model_are_those_of_its_tensors() -> None:
    gaussians = random_gaussians(10, seed=0, dtype=torch.float32)
    numbers = sum(tensor.numel() for tensor in gaussians.tensors().values())
    assert numbers == 10 * (3 + 3 + 4 + 1 + 3 + 3 * NUM_SH_REST)
    assert 4 * 4 * numbers == 10 * BYTES_OF_MODEL  # float32; with gradient and two moments


def test_room(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logging.getLogger("gsbench"), "propagate", True)
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


def test_the_words_when_it_happens() -> None:
    text = str(explain_full(70, 1_234_567, torch.device("cuda:1"), "the last good state is X"))
    assert "iteration 70: cuda:1 has no memory left at 1,234,567 Gaussians; the last good state is X; lower" in text
    assert "\n" not in text
