"""Adam on the CPU: for whole parameters, and within the backward pass of a training step."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from gsbench.gaussians.model import Gaussians
from gsbench.gaussians.trainable import TrainableGaussians, Update, torch_adam
from gsbench.raster.base import RenderOutput
from gsbench.raster.cpu.adam import adam_rows
from gsbench.raster.cpu.executor import CpuRasterizer, parameter_arrays
from gsbench.raster.cpu.layout import AdamStep
from gsbench.raster.cpu.workspace import ShardRunner
from gsbench.raster.staged import Lifetime, RenderRequest, check_settings
from gsbench.scene.types import Camera
from gsbench.train.loss_cpu import CompiledLoss

SHARDS = 16


class CpuAdam:
    """Adam for `TrainableGaussians` on the CPU; see `gsbench.gaussians.trainable.StepAll`."""

    def __init__(self, threads: int) -> None:
        self._runner = ShardRunner(threads)

    def __call__(
        self, updates: Sequence[Update], seen: Tensor | None = None, visible: Tensor | None = None
    ) -> None:
        """Apply Adam, to visible Gaussians only (`torch_adam`) or in the kernel."""
        if visible is not None:
            torch_adam(updates, seen, visible)
            return
        for update in updates:
            self._step(update)

    def _step(self, update: Update) -> None:
        parameter, gradient, state, active, _ = update
        count, width = len(parameter), parameter.shape[1:].numel()
        arrays = [
            tensor.detach().numpy().reshape(count, width)
            for tensor in (parameter, state.first, state.second, gradient.contiguous())
        ]
        numbers = (width if active is None else active, *map(np.float32, state.factors))
        spare = np.empty((SHARDS, 64), np.float32)
        self._runner.run(SHARDS, adam_rows, spare, *arrays, *numbers)


class FusedStep:
    """A training step of `CpuRasterizer` and `CompiledLoss` without autograd.

    The backward pass applies Adam while the gradients are in the cache. All bits are those of a
    step by autograd and `CpuAdam`.
    """

    applies_adam = True

    def __init__(self, rasterizer: CpuRasterizer, loss: CompiledLoss, background: Tensor) -> None:
        self._rasterizer, self._loss, self._background = rasterizer, loss, background

    def step(
        self,
        gaussians: TrainableGaussians,
        camera: Camera,
        target: Tensor,
        degree: int,
        absolute: bool,
        extra: str | None = None,
        mask: Tensor | None = None,
        regularizer: Tensor | None = None,
    ) -> tuple[RenderOutput, Tensor]:
        """See `gsbench.train.trainer.FastStep`; the last three arguments must be None.

        Raises ValueError, which names the parameter, for a parameter that is out of range.
        """
        values = gaussians.values.detach()
        check_settings(values, camera, degree, self._background)
        points = torch.zeros_like(values.means[:, :2], requires_grad=True)
        summed = torch.zeros_like(points) if absolute else None
        request = RenderRequest(camera, degree, self._background, summed, None, Lifetime())
        image, alpha, radii, passed = self._rasterizer.forward(values, request)
        scalars, g_image = self._loss.compute(image, target.contiguous(), differentiate=True)
        assert g_image is not None
        states = gaussians.count_step()
        adam = AdamStep(
            parameter_arrays(Gaussians(*(state.first for state in states))),
            parameter_arrays(Gaussians(*(state.second for state in states))),
            np.array([state.factors for state in states], np.float32),
            3 * ((degree + 1) ** 2 - 1),
        )
        points.grad = self._rasterizer.backward_and_step(passed, values, request, g_image, adam)
        return RenderOutput(image, alpha, radii, points, summed), scalars

    def optimize(self, gaussians: TrainableGaussians) -> None:
        """Do nothing: `step` has applied Adam."""
