"""Training images stay on the device if they fit.

If not, they are copied: tests/train/test_trainer.py trains so to the same bits.
"""

import numpy as np
import pytest
import torch

from gsbench.scene.types import View
from gsbench.train.views import Targets
from tests.gaussians.helpers import front_camera

CPU = torch.device("cpu")


@pytest.fixture
def views():
    """Seven images of different sizes and content."""
    rng = np.random.default_rng(3)
    sizes = [(12, 9), (5, 7), (12, 9), (3, 30), (8, 8), (1, 1), (12, 10)]
    images = [rng.integers(0, 256, (height, width, 3), dtype=np.uint8) for width, height in sizes]
    return [View(f"{k}.png", front_camera(i.shape[1], i.shape[0]), i) for k, i in enumerate(images)]


def test_images_that_fit_stay_on_the_device(views):
    size = sum(view.image.size for view in views)
    for budget in (None, size):
        targets = Targets(views, CPU, budget)
        assert targets.resident
        assert targets.bytes == size
        # on the CPU nothing is copied
        assert targets.get(0).data_ptr() == views[0].image.ctypes.data
    assert not Targets(views, CPU, size - 1).resident
