"""The host's cost of a training step, measured without a GPU: ``python -m benchmarks.host``.

All kernels are replaced by launches that do nothing, and tensors are tiny, so that only the host's
work remains: Python, torch's operations, autograd. A recorded graph becomes a call that does
nothing. The costs of Triton's launcher and of CUDA's runtime are not in it; the counts of launches
and operations say how often they are paid.
"""

from __future__ import annotations

import ctypes
import itertools
import json
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from gsbench.bench.measure import UNUSED_FOLDER, constant_scene_options
from gsbench.bench.scenes import SEED, make_scene
from gsbench.densify import ADC, MCMC, Densifier, adc
from gsbench.raster.triton import executor, lists
from gsbench.raster.triton.executor import TritonRasterizer
from gsbench.train import adam_triton, direct, loss_triton
from gsbench.train.adam_triton import TritonAdam
from gsbench.train.direct import DirectStep
from gsbench.train.loss_triton import TritonLoss
from gsbench.train.trainer import Trainer

WIDTH, HEIGHT, COUNT = 32, 16, 64  # px, px, Gaussians: so few that their values cost nothing
MASKED = "adc, masks, visible_adam"
TRAININGS = ("adc", MASKED, "mcmc")
WAYS = ("autograd", "direct", "recorded")
STEPS, REPEATS, WARM_UP = 20, 7, 4
SIZES = [2 * COUNT, 4 * COUNT, 0]  # units, pairs, no bad value


class Counts(TorchDispatchMode):
    """Counts the operations of torch."""

    def __init__(self) -> None:
        super().__init__()
        self.operations = 0

    def __torch_dispatch__(
        self, operation: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        self.operations += 1
        return operation(*args, **(kwargs or {}))


class _Sizes:
    """Stands in for `gsbench.raster.staged.Readback` of the sizes of lists."""

    def __init__(self, source: Tensor) -> None:
        pass

    def values(self) -> Tensor:
        return torch.tensor(SIZES)


class _NullPool:
    """Stands in for a pool of graphs. Recording makes the launches once; replaying does nothing."""

    def record(self, launches: Any) -> Any:
        launches()
        return lambda: None


class NullDevice:
    """One of `TRAININGS` whose kernels do nothing; ``way`` is one of `WAYS`."""

    def __init__(self, training: str, way: str) -> None:
        self.launches = 0
        gaussians, scene = make_scene("trained", WIDTH, HEIGHT, COUNT)
        masked = training == MASKED
        options = replace(constant_scene_options(), visible_adam=masked)
        if masked:
            mask = np.ones((HEIGHT, WIDTH), dtype=np.bool_)
            scene = replace(scene, train=tuple(replace(view, mask=mask) for view in scene.train))
        never = options.iterations
        densifier: Densifier = ADC(start=never - 1, stop=never, opacity_reset_interval=never)
        if training == "mcmc":
            densifier = MCMC(start=never - 1, stop=never)
        self.trainer = Trainer(scene, gaussians, densifier, TritonRasterizer(), options, SEED)
        trainer = self.trainer
        trainer.gaussians.step_all = TritonAdam()
        trainer.loss = TritonLoss(options.ssim_weight)  # type: ignore[assignment]
        trainer.step = 3  # full degree of harmonics
        if way != "autograd":
            recorded = way == "recorded"
            trainer.fast = DirectStep(
                TritonRasterizer(),
                TritonLoss(options.ssim_weight),
                trainer.background,
                recorded,
                options.visible_adam,
            )
            vars(trainer.fast)["pool"] = _NullPool()

    def step(self) -> None:
        self.trainer.iterate(UNUSED_FOLDER)

    def _launch(self, kernel: Any, *programs: Any) -> Any:
        def count(**arguments: Any) -> None:
            self.launches += 1
            if kernel is loss_triton.add_up:  # the loss must be a number
                values = arguments["values"]
                ctypes.memset(values.data_ptr(), 0, values.nbytes)  # no operation of torch

        return count

    @contextmanager
    def running(self) -> Iterator[None]:
        """Replace the kernels within this context."""
        with (
            mock.patch.multiple(executor, launch=self._launch, launch_grid=self._launch),
            mock.patch.multiple(lists, launch=self._launch, launch_grid=self._launch),
            mock.patch.object(loss_triton, "launch_grid", self._launch),
            mock.patch.object(adam_triton, "launch", self._launch),
            mock.patch.object(executor, "Readback", _Sizes),
            mock.patch.object(direct, "Readback", _Sizes),
            mock.patch.object(adc, "lengths_of", lambda vectors: vectors.norm(dim=-1)),
        ):
            for _ in range(WARM_UP):
                self.step()
            yield


def count_step(training: str, way: str) -> tuple[int, int]:
    """The numbers of launches and of torch's operations in one step."""
    device = NullDevice(training, way)
    with device.running():
        device.launches = 0
        with Counts() as counts:
            device.step()
        return device.launches, counts.operations


def time_host() -> list[dict[str, Any]]:
    """A row for each of `TRAININGS` and `WAYS`: launches, operations and ms of the host in a step.

    Times are medians; the rows take turns.
    """
    devices = {both: NullDevice(*both) for both in itertools.product(TRAININGS, WAYS)}
    times: dict[tuple[str, str], list[float]] = {both: [] for both in devices}
    for _ in range(REPEATS):
        for both, device in devices.items():
            with device.running():
                begin = time.perf_counter()
                for _ in range(STEPS):
                    device.step()
                times[both].append(1e3 * (time.perf_counter() - begin) / STEPS)
    rows = []
    for training, way in devices:
        launches, operations = count_step(training, way)
        rows.append(
            {
                "training": training,
                "way": way,
                "launches": launches,
                "operations": operations,
                "host_ms": round(statistics.median(times[training, way]), 3),
            }
        )
    return rows


if __name__ == "__main__":
    print(json.dumps(time_host(), indent=2))
