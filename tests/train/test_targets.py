"""Training images that are streamed are the same images, whatever is asked for next."""

from __future__ import annotations

import random

import numpy as np
import pytest
import torch

from gsbench.scene.types import View
from gsbench.train.views import Targets
from tests.gaussians.helpers import front_camera

CPU = torch.device("cpu")


@pytest.fixture
def views() -> list[View]:
    """Seven images of different sizes and content."""
    rng = np.random.default_rng(3)
    sizes = [(12, 9), (5, 7), (12, 9), (3, 30), (8, 8), (1, 1), (12, 10)]
    images = [rng.integers(0, 256, (height, width, 3), dtype=np.uint8) for width, height in sizes]
    return [View(f"{k}.png", front_camera(i.shape[1], i.shape[0]), i) for k, i in enumerate(images)]


def test_what_fits_is_resident(views: list[View]) -> None:
    size = sum(view.image.size for view in views)
    for budget in (None, size):
        targets = Targets(views, CPU, budget)
        assert targets.resident
        assert targets.bytes == size
        targets.prefetch(3)
        assert targets.get(0).data_ptr() == views[0].image.ctypes.data  # on the CPU nothing is copied
    assert not Targets(views, CPU, size - 1).resident


def test_streamed_images_are_whole_however_they_are_asked_for(views: list[View]) -> None:
    targets = Targets(views, CPU, budget=0)
    rng = random.Random(5)
    held: list[tuple[int, torch.Tensor]] = []
    for _ in range(200):
        index = rng.randrange(len(views))
        if rng.random() < 0.7:
            targets.prefetch(index if rng.random() < 0.8 else rng.randrange(len(views)))
        held = [*held[-3:], (index, targets.get(index))]
        for asked, image in held:  # an image stays what it was while others are copied
            assert image.dtype == torch.uint8
            assert np.array_equal(image.numpy(), views[asked].image)
