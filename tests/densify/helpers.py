"""Helpers for tests of densifiers: Gaussians in training, made-up renders, checks of a round."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from gsbench.densify import RefineEvent, Refinement
from gsbench.gaussians.paper_values import LearningRates
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster.base import RenderOutput
from tests.densify import restatement

EXTENT = 4.0
# rounds before and after the first opacity reset
around_a_reset = pytest.mark.parametrize("step", [600, 3100])


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def trained(gaussians, extent=EXTENT):
    return TrainableGaussians(gaussians, LearningRates(), extent)


def with_moments(gaussians):
    """Take one step of Adam, so that there are moments for edits to keep."""
    trainable = trained(gaussians)
    for tensor in trainable.values.tensors().values():
        tensor.grad = torch.full_like(tensor, 1e-3)
    trainable.optimizer_step()
    return trainable


def at(step, trainable, seed=0):
    return Refinement(step, trainable, generator(seed), RefineEvent(step, len(trainable)))


def rendered(gradient, radii=None, absolute=None, **more):
    """A render without pixels, with the screen gradients ``gradient`` [N, 2].

    All Gaussians are visible if no ``radii`` are given.
    """
    points = torch.zeros(len(gradient), 2, dtype=torch.float64, requires_grad=True)
    points.grad = torch.as_tensor(gradient, dtype=torch.float64)
    seen = torch.ones(len(gradient)) if radii is None else torch.as_tensor(radii)
    none = torch.empty(0)
    return RenderOutput(none, none, seen.to(torch.int32), points, absolute, **more)


def gathered(densifier, gradient, absolute=None):
    """Set the statistics as if all Gaussians were visible once, with these gradients [N]."""
    densifier.statistics["gradient_sum"] = torch.as_tensor(gradient)
    densifier.statistics["visible_count"][:] = 1
    if absolute is not None:
        densifier.statistics["absolute_sum"] = torch.as_tensor(absolute)


def to_rows(trainable):
    tensors = dict(trainable.values.tensors())
    for name, state in trainable.adam.items():
        tensors |= {f"first {name}": state.first, f"second {name}": state.second}
    return [
        {name: tensor[i].detach().numpy().copy() for name, tensor in tensors.items()}
        for i in range(len(trainable))
    ]


def noise_of(seed, *counts):
    """The rows of the real code's normal draws: [2 S, 3] for each rule that splits S parents."""
    rng = generator(seed)
    draws = [torch.randn(2 * s, 3, generator=rng, dtype=torch.float64).numpy() for s in counts]
    return iter([row for batch in draws for row in batch])


def assert_same(trainable, rows):
    found = to_rows(trainable)
    assert len(found) == len(rows)
    for real, expected in zip(found, rows, strict=True):
        assert real.keys() == expected.keys()
        for name, value in real.items():
            assert_allclose(value, expected[name], rtol=1e-5, atol=1e-7, err_msg=name)
            apart = np.abs(value - expected[name]) / np.maximum(1, np.abs(expected[name]))
            restatement.DIFFERENCES.append(float(apart.max(initial=0)))


class Round:
    """A real round at ``step``, with the state before it; ``check`` compares the result."""

    def __init__(self, densifier, trainable, step, seed=0):
        self.densifier, self.trainable, self.step = densifier, trainable, step
        self.rows, self.counts = to_rows(trainable), {}
        forecast = getattr(densifier, "forecast", None)
        capped = getattr(densifier, "cap", "soft") not in ("soft", "freeze", "governor")
        self.foreseen = None if forecast is None or capped else forecast(at(step, trainable))
        event = densifier.refine(step, trainable, generator(seed))
        assert event is not None
        self.event = event
        self.noise = noise_of(seed, event.split_gradient, event.split_volume)

    def grown(self, mean_gradient, rows=None):
        """The rows after the growth of ADC, for these gradients [N]."""
        rows = self.rows if rows is None else rows
        return restatement.adc_growth(rows, mean_gradient, EXTENT, self.noise, self.counts)

    def check(self, rows, pruned=False):
        """Compare with the restated ``rows``, after pruning these as ADC does unless ``pruned``."""
        if not pruned:
            rows = restatement.prune(rows, self.step, EXTENT, self.counts)
        assert_same(self.trainable, rows)
        assert self.counts == {name: getattr(self.event, name) for name in self.counts}
        assert self.event.balances()
        assert self.event.after == len(rows) == len(self.densifier.lineage.ids)
        assert self.foreseen in (None, self.event.after)
