"""Steps of harmonics that are put off (see `gsbench.gaussians.deferred`), on a GPU."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
import triton
import triton.language as tl
from numpy.typing import NDArray
from torch import Tensor

from gsbench.gaussians import spherical_harmonics
from gsbench.gaussians.deferred import BETA1, BETA2, HORIZON, Coasting, DeferredHarmonics
from gsbench.gaussians.model import NUM_SH_REST
from gsbench.raster.triton.harmonics import REST, basis, coasting_direction
from gsbench.raster.triton.launch import launch
from gsbench.raster.triton.layout import FACTORS, G_COLOR, LAST, TO

KEEP_FIRST, KEEP_SECOND = tl.constexpr(BETA1), tl.constexpr(BETA2)
TAKE_FIRST, TAKE_SECOND = tl.constexpr(1 - BETA1), tl.constexpr(1 - BETA2)
NUMBERS = tl.constexpr(64)  # a power of two, at least REST
GAUSSIANS = 8  # of a program of `step_harmonics`


@triton.jit(do_not_specialize=["count", "step"])
def step_harmonics(
    factors,
    factor_ints,
    count,
    values,
    first,
    second,
    last,
    drift,
    first_decay,
    second_decay,
    step,
    size,
    spread,
    epsilon,
    DEGREE: tl.constexpr,
    GROUP: tl.constexpr,
):
    """Make the step after ``step`` for the Gaussians seen: p -= size * m / (spread * sqrt(v) + epsilon).

    First come those that they have missed. A program has ``GROUP`` Gaussians, whose numbers lie side by side in its
    lanes, as in memory.
    """
    index = tl.program_id(0).to(tl.int64) * GROUP + tl.arange(0, GROUP)  # [GROUP]
    place = index * FACTORS
    before = tl.load(factor_ints + place + LAST, mask=index < count, other=-1)
    seen = before >= 0
    missed = tl.where(seen, step - before, 0)
    keep_first = KEEP_FIRST * tl.load(first_decay + missed)
    keep_second = KEEP_SECOND * tl.load(second_decay + missed)
    coasted = tl.load(drift + before, mask=seen, other=0.0)
    direction = (
        tl.load(factors + place + TO, mask=seen, other=0.0),
        tl.load(factors + place + TO + 1, mask=seen, other=0.0),
        tl.load(factors + place + TO + 2, mask=seen, other=0.0),
    )
    functions = basis(direction, DEGREE)

    number = tl.arange(0, NUMBERS)[None, :]
    mask = seen[:, None] & (number < REST)  # [GROUP, NUMBERS]
    gradient = tl.load(factors + place[:, None] + G_COLOR + number % 3, mask=mask, other=0.0)
    function = tl.zeros_like(gradient)
    for k in tl.static_range(0, (DEGREE + 1) * (DEGREE + 1) - 1):
        function = tl.where(number // 3 == k, functions[k][:, None], function)
    gradient *= function

    numbers = index[:, None] * REST + number
    value = tl.load(values + numbers, mask=mask, other=0.0)
    m = tl.load(first + numbers, mask=mask, other=0.0)
    v = tl.load(second + numbers, mask=mask, other=0.0)
    value -= coasting_direction(m, v) * coasted[:, None]
    m = tl.fma(gradient, TAKE_FIRST, m * keep_first[:, None])
    v = tl.fma(gradient * gradient, TAKE_SECOND, v * keep_second[:, None])
    tl.store(values + numbers, value - m * size / (tl.sqrt(v) * spread + epsilon), mask=mask)
    tl.store(first + numbers, m, mask=mask)
    tl.store(second + numbers, v, mask=mask)
    tl.store(last + index, step + 1, mask=seen)


class Tables:
    """The tables of a `Coasting` on a device."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._step = 0
        self.drift = self.first_decay = self.second_decay = torch.empty(0, device=device)

    def follow(self, coasting: Coasting) -> Tables:
        """Bring what has changed in ``coasting`` to the device; the host does not wait."""
        if len(self.drift) != len(coasting.drift):
            self.drift, self.first_decay, self.second_decay = (
                torch.empty(len(coasting.drift), dtype=torch.float32, device=self._device) for _ in range(3)
            )
            _upload(coasting.drift, self.drift)
            _upload(coasting.first_decay, self.first_decay)
            _upload(coasting.second_decay, self.second_decay)
        elif self._step != coasting.step:
            changed = slice(max(0, self._step + 1 - HORIZON), coasting.step)
            _upload(coasting.drift[changed], self.drift[changed])
        self._step = coasting.step
        return self


def _upload(values: NDArray[np.float32], target: Tensor) -> None:
    source = torch.frombuffer(values, dtype=torch.float32)  # from_numpy would count as an upload (bench.waits)
    if target.device.type == "cuda":
        source = source.pin_memory()  # copied at once, from memory that the device reads when it comes so far
    target.copy_(source, non_blocking=True)


@dataclass(frozen=True)
class Pending:
    """Harmonics whose steps are put off, if any, with the tables of what they have missed."""

    harmonics: DeferredHarmonics | None
    tables: Tables | None

    def tensors(self, unused: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The moments, the last step of each Gaussian and the table of drifts; ``unused`` where nothing is put off."""
        if self.harmonics is None or self.tables is None:
            return unused, unused, unused.view(torch.int32), unused
        return self.harmonics.first, self.harmonics.second, self.harmonics.last, self.tables.drift


class Factors:
    """The gradient of harmonics that the backward pass left; a `gsbench.gaussians.deferred.HarmonicsGradient`."""

    def __init__(self, tables: Tables, memory: Tensor, degree: int) -> None:
        self._tables = tables
        self._memory = memory  # [N, FACTORS]
        self._degree = degree  # at least 1

    def step(self, harmonics: DeferredHarmonics, rate: float, epsilon: float) -> None:
        step, count = harmonics.coasting.step, len(self._memory)
        with torch.cuda.device_of(self._memory):
            tables = self._tables.follow(harmonics.coasting)
            launch(step_harmonics, count, GAUSSIANS)(
                self._memory,
                self._memory.view(torch.int32),
                count,
                harmonics.values.detach(),
                harmonics.first,
                harmonics.second,
                harmonics.last,
                tables.drift,
                tables.first_decay,
                tables.second_decay,
                step,
                rate / (1 - BETA1 ** (step + 1)),
                1 / math.sqrt(1 - BETA2 ** (step + 1)),
                epsilon,
                DEGREE=self._degree,
            )

    def dense(self) -> Tensor:
        seen = self._memory.view(torch.int32)[:, LAST.value] >= 0  # [N]
        directions, color = self._memory[:, :3], self._memory[:, 3:6]
        functions = spherical_harmonics.basis(directions, self._degree)[:, 1:]  # [N, K]
        gradient = self._memory.new_zeros(len(self._memory), NUM_SH_REST, 3)
        product = functions[:, :, None] * color[:, None]  # [N, K, 3]
        gradient[:, : functions.shape[1]] = torch.where(seen[:, None, None], product, 0.0)
        return gradient
