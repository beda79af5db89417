"""Steps of harmonics that are put off come to the same as dense steps."""

from __future__ import annotations

import numpy as np
import torch

from gsbench.gaussians.trainable import LearningRates, TrainableGaussians
from gsbench.raster.base import RenderOutput
from gsbench.raster.contract import Case
from gsbench.raster.cpu import CpuRasterizer
from gsbench.scene.camera import Camera

SCENE = Case(48, 40, 160, sh_degree=3)
STEPS = 500
FLOAT32 = 1.2e-7
BACKGROUND = torch.tensor([0.2, 0.5, 0.9])


def cameras() -> list[Camera]:
    """Six views between which most Gaussians come and go."""
    found = []
    for k in range(6):
        angle = 0.5 * (k - 2.5)
        rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        found.append(Camera(48, 40, 60.0, 60.0, 24.0, 20.0, rotation, np.array([0.1, -0.2, 0.3])))
    return found


class Pair:
    """The same training twice, with and without putting off. Geometry stands still, so that both see the same."""

    def __init__(self) -> None:
        still = dict.fromkeys(("position_initial", "position_final", "opacity", "scale", "rotation"), 1e-30)
        self.rates = LearningRates(**still, sh_dc=2.5e-3, sh_rest=2.5e-3)
        self.rasterizer = CpuRasterizer(threads=1)
        initial = SCENE.gaussians().map(torch.Tensor.float)
        self.dense = TrainableGaussians(initial, self.rates, 1.0)
        self.lazy = TrainableGaussians(initial, self.rates, 1.0)
        self.lazy.defer_harmonics()

    def render(self, trainable: TrainableGaussians, camera: Camera, degree: int = 3) -> RenderOutput:
        if trainable.deferred is None:
            return self.rasterizer.render(trainable.values, camera, degree, BACKGROUND)
        return self.rasterizer.render_deferred(trainable.leaves, trainable.deferred, camera, degree, BACKGROUND)

    def step(self, camera: Camera, degree: int = 3) -> None:
        for trainable in (self.dense, self.lazy):
            self.render(trainable, camera, degree).image.square().sum().backward()
            trainable.optimizer_step(degree)

    def both(self) -> tuple[TrainableGaussians, TrainableGaussians]:
        return self.dense, self.lazy


def test_five_hundred_steps_with_everything_that_can_happen_in_between() -> None:
    """Idle steps at degree 0, a densification, an opacity reset, a resume, and a look at a gradient."""
    pair, views = Pair(), cameras()
    order = torch.randint(6, (STEPS,), generator=torch.Generator().manual_seed(3)).tolist()
    behind = 0
    for step in range(STEPS):
        pair.step(views[order[step]], degree=min(3, step // 20))
        lazy = pair.lazy.deferred
        behind = max(behind, int((lazy.coasting.step - lazy.last).max()))
        if step == 150:  # pruned while steps are missing, then grown: nobody looks at the values themselves
            assert (lazy.last < lazy.coasting.step).any()
            keep = torch.arange(len(pair.lazy)) % 7 != 3
            added = pair.dense.values.detach().select(torch.arange(0, 30, 2))
            for trainable in pair.both():
                trainable.edit(keep)
                trainable.edit(append=added)
            assert (pair.lazy.deferred.last < lazy.coasting.step).any()
        if step == 250:
            for trainable in pair.both():
                trainable.overwrite("opacity_logits", trainable.values.opacity_logits.detach().clamp_max(0.5))
        if step == 350:
            state = pair.lazy.state_dict()
            assert state["deferred"]["last"].min() < lazy.coasting.step  # saved as it is
            pair.lazy = TrainableGaussians.load(state, pair.rates, 1.0)
        if step == 400:  # the gradient is wanted as a tensor, before the step
            for trainable in pair.both():
                pair.render(trainable, views[0]).image.square().sum().backward()
            torch.testing.assert_close(
                pair.lazy.values.sh_rest.grad, pair.dense.values.sh_rest.grad, rtol=1e-3, atol=1e-5
            )
            for trainable in pair.both():
                trainable.optimizer_step()
    assert behind > 20
    moved = (pair.dense.values.sh_rest - SCENE.gaussians().sh_rest.float().mean()).abs().max()
    assert moved > 0.1
    snapshot = pair.lazy.snapshot()
    for name, expected in pair.dense.values.tensors().items():
        found = getattr(snapshot, name)
        assert torch.equal(getattr(pair.lazy.values, name).detach(), found), name
        assert (found - expected).abs().max() < 1e-4 * expected.abs().max(), name


def test_coasting_is_adam_with_zero_gradients_to_the_last_digits() -> None:
    """One gradient, then up to 400 steps without any: against torch's Adam in float64."""
    for missed in (1, 2, 7, 60, 400):
        trainable = TrainableGaussians(SCENE.gaussians().map(torch.Tensor.float), LearningRates(), 1.0)
        exact = TrainableGaussians(SCENE.gaussians(), LearningRates(), 1.0)
        gradient = torch.randn(160, 15, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        gradient[5] = 0
        for each in (trainable, exact):
            before = each.values.sh_rest.detach().clone()
            each.values.sh_rest.grad = gradient.to(before.dtype)
            each.optimizer_step()
        trainable.defer_harmonics()
        for _ in range(missed):
            trainable.deferred.coasting.advance(LearningRates().sh_rest)
            exact.values.sh_rest.grad = torch.zeros_like(exact.values.sh_rest)
            exact.optimizer_step()
        settled = trainable.deferred.settled()
        state = exact.optimizer.state[exact.leaves.sh_rest]
        assert torch.equal(settled[0][5], trainable.leaves.sh_rest[5])
        torch.testing.assert_close(settled[0].double(), exact.values.sh_rest.detach(), rtol=4 * FLOAT32, atol=1e-9)
        torch.testing.assert_close(settled[1].double(), state["exp_avg"], rtol=2e-6, atol=1e-30)
        torch.testing.assert_close(settled[2].double(), state["exp_avg_sq"], rtol=2e-6, atol=1e-30)
