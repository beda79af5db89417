"""Pixel-GS against a restatement, one Gaussian and one view at a time."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsbench.densify import ADC, DensifyContext, PixelGS, Refinement
from gsbench.gaussians.paper_values import LearningRates
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.raster.base import Footprint, RenderOutput
from tests.densify import restatement
from tests.densify.test_rounds import EXTENT, assert_same, noise_of, to_rows
from tests.gaussians.helpers import random_gaussians

COUNT = 60
VIEWS = 4


class Views:
    """Made-up gradients [V, N, 2], pixels, depths and radii [V, N] of a few views."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.gradients = rng.exponential(2e-4, (VIEWS, COUNT, 2))
        self.pixels = rng.integers(0, 400, (VIEWS, COUNT)) * (rng.random((VIEWS, COUNT)) < 0.7)
        self.depths = rng.uniform(-1, 1.5 * EXTENT, (VIEWS, COUNT))
        self.radii = np.where(self.pixels > 0, 3, rng.integers(0, 2, (VIEWS, COUNT)))

    def show(self, densifier: ADC, trainable: TrainableGaussians) -> None:
        densifier.begin(trainable.values.detach(), DensifyContext(EXTENT))
        for view in range(VIEWS):
            points = torch.zeros(COUNT, 2, dtype=torch.float64, requires_grad=True)
            points.grad = torch.from_numpy(self.gradients[view])
            none = torch.empty(0)
            radii = torch.from_numpy(self.radii[view].astype(np.int32))
            covered = torch.from_numpy(self.pixels[view].astype(np.int32))
            footprint = Footprint(covered, torch.from_numpy(self.depths[view]), none, none)
            render = RenderOutput(none, none, radii, points, points.grad, lambda values=None, f=footprint: f)
            densifier.observe(view + 1, render)

    def mean_gradient(self, fraction: float | None) -> np.ndarray:
        """The growth condition of the paper, term by term."""
        means = np.zeros(COUNT)
        for i in range(COUNT):
            above = below = 0.0
            for k in range(VIEWS):
                m = self.pixels[k, i]
                f = 1.0
                if fraction is not None:
                    f = min(max((self.depths[k, i] / (fraction * EXTENT)) ** 2, 0), 1)
                above += m * f * np.hypot(*self.gradients[k, i])
                below += m
            means[i] = above / below if below else 0
        return means


def started(seed: int, densifier: ADC) -> tuple[TrainableGaussians, Views]:
    gaussians = random_gaussians(COUNT, seed, log_scale=(-6.0, 0.3))
    trainable = TrainableGaussians(gaussians, LearningRates(), EXTENT)
    for tensor in trainable.values.tensors().values():
        tensor.grad = torch.full_like(tensor, 1e-3)
    trainable.optimizer_step()
    views = Views(seed)
    views.show(densifier, trainable)
    return trainable, views


@pytest.mark.parametrize("fraction", [0.37, 1.0, None])
@pytest.mark.parametrize("seed", range(3))
def test_pixel_gs_round(seed: int, fraction: float | None) -> None:
    densifier = PixelGS(near_fraction=fraction)
    trainable, views = started(seed, densifier)
    rows, expected = to_rows(trainable), {}
    foreseen = densifier.forecast(Refinement(3100, trainable, torch.Generator(), event=None))  # type: ignore[arg-type]
    gradient = views.mean_gradient(fraction)
    np.testing.assert_allclose(densifier.mean_gradient(), gradient, rtol=1e-5)
    event = densifier.refine(3100, trainable, torch.Generator().manual_seed(seed))
    noise = iter(noise_of(seed, [event.split_gradient]))
    rows = restatement.prune(restatement.adc_growth(rows, gradient, EXTENT, noise, expected), 3100, EXTENT, expected)
    assert_same(trainable, rows)
    assert expected == {name: getattr(event, name) for name in expected}
    assert event.cloned > 0
    assert event.split_gradient > 0
    assert event.balances()
    assert event.after == foreseen
    assert not densifier.statistics["pixel_sum"].any()  # gathered anew


def test_views_of_equal_footprints_count_as_in_adc() -> None:
    """Weights that are all alike cancel; views without a pixel do not count at all."""
    views, densifier, baseline = Views(5), PixelGS(near_fraction=None), ADC()
    views.pixels[:] = 7
    views.radii[:] = 1
    trainable = TrainableGaussians(random_gaussians(COUNT), LearningRates(), EXTENT)
    for each in (densifier, baseline):
        views.show(each, trainable)
    torch.testing.assert_close(densifier.mean_gradient(), baseline.mean_gradient())
    views.pixels[1:] = 0
    views.show(densifier, trainable)
    np.testing.assert_allclose(densifier.mean_gradient(), np.hypot(*views.gradients[0].T), rtol=1e-6)


def test_large_gaussians_at_the_edge_of_views_are_not_held_back() -> None:
    """The paper's motive: one view in which much of it is seen, three that see an edge and have no gradient."""
    views, densifier, baseline = Views(0), PixelGS(near_fraction=None), ADC()
    views.gradients[:] = 0
    views.gradients[0] = 3e-4
    views.pixels[:], views.pixels[0], views.radii[:] = 2, 600, 50
    trainable = TrainableGaussians(random_gaussians(COUNT), LearningRates(), EXTENT)
    for each in (densifier, baseline):
        views.show(each, trainable)
    assert (baseline.mean_gradient() < 2e-4).all()
    assert (densifier.mean_gradient() > 4e-4).all()


def test_a_hard_cap_takes_those_of_the_largest_weighted_gradient() -> None:
    densifier = PixelGS(max_gaussians=COUNT + 5, cap="hard", prune_opacity=0.0)
    trainable, views = started(1, densifier)
    event = densifier.refine(600, trainable, torch.Generator())
    assert event.after == COUNT + 5
    parents = densifier.lineage.state_dict()["parents"][COUNT:].unique()
    assert sorted(parents.tolist()) == sorted(np.argsort(-views.mean_gradient(0.37), kind="stable")[:5].tolist())


def test_a_render_that_does_not_say_is_refused() -> None:
    densifier = PixelGS()
    densifier.begin(random_gaussians(2), DensifyContext(1.0))
    points = torch.zeros(2, 2, requires_grad=True)
    points.grad = torch.zeros(2, 2)
    with pytest.raises(RuntimeError, match="footprint"):
        densifier.observe(1, RenderOutput(torch.empty(0), torch.empty(0), torch.ones(2, dtype=torch.int32), points))
