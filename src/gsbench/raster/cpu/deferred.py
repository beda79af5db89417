"""Adam of harmonics for the Gaussians that a view shows, from a gradient that is never written out.

The gradient of a Gaussian's 45 coefficients is the basis at its direction times the gradient of its colour: six
numbers, its factors. See `gsbench.gaussians.deferred` for what is put off and how it is made up for.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.gaussians.deferred import BETA1, BETA2, DeferredHarmonics
from gsbench.gaussians.model import NUM_SH_REST
from gsbench.gaussians.spherical_harmonics import basis
from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.harmonics import fill_basis
from gsbench.raster.cpu.shuffle import REST, load_rest, outer_rest, store_rest
from gsbench.raster.cpu.simd import fma, load, prefetch, select, square_root
from gsbench.raster.cpu.vector import LANES
from gsbench.raster.cpu.workspace import ShardRunner
from gsbench.system.jit import inlined, kernel

# A chunk of factors: 16 Gaussians, a row of 16 float32 for each of these.
TO_X, TO_Y, TO_Z, G_RED, G_GREEN, G_BLUE = range(6)  # direction from the camera, gradient of the colour
INDEX = 6  # int32: the Gaussian
CHUNK = 7 * LANES
ZERO = np.float32(0)
KEEP_FIRST, KEEP_SECOND = np.float32(BETA1), np.float32(BETA2)
TAKE_FIRST, TAKE_SECOND = np.float32(1 - BETA1), np.float32(1 - BETA2)


class Pending(NamedTuple):
    """`DeferredHarmonics` for the kernels; all empty where nothing is put off."""

    first: NDArray[np.float32]  # [N * 45]
    second: NDArray[np.float32]  # [N * 45]
    last: NDArray[np.int32]  # [N]
    step: int
    drift: NDArray[np.float32]  # [> step]
    first_decay: NDArray[np.float32]  # [> step]
    second_decay: NDArray[np.float32]  # [> step]


def pending_of(harmonics: DeferredHarmonics | None) -> Pending:
    """The arrays of ``harmonics`` that kernels need, sharing its memory."""
    if harmonics is None:
        empty = np.empty(0, np.float32)
        return Pending(empty, empty, np.empty(0, np.int32), 0, empty, empty, empty)
    coasting = harmonics.coasting
    return Pending(
        harmonics.first.numpy().reshape(-1),
        harmonics.second.numpy().reshape(-1),
        harmonics.last.numpy(),
        coasting.step,
        coasting.drift,
        coasting.first_decay,
        coasting.second_decay,
    )


@inlined
def load_settled(sh_rest: Any, i: int, pending: Any) -> Any:
    """The harmonics of Gaussian i as `load_rest` gives them, after the steps that it has missed, if any."""
    values = load_rest(sh_rest, i * REST)
    if len(pending.last) == 0 or pending.last[i] == pending.step:
        return values
    drift = pending.drift[pending.last[i]]
    return _coasted(values, load_rest(pending.first, i * REST), load_rest(pending.second, i * REST), drift)


@inlined
def _coasted(values: Any, first: Any, second: Any, drift: Any) -> Any:
    return (
        values[0] - _direction(first[0], second[0]) * drift,
        values[1] - _direction(first[1], second[1]) * drift,
        values[2] - _direction(first[2], second[2]) * drift,
    )


@inlined
def _direction(first: Any, second: Any) -> Any:
    return select(second > ZERO, first / square_root(second), ZERO)


@inlined
def _moments(first: Any, second: Any, gradient: Any, keep_first: Any, keep_second: Any) -> Any:
    return fma(gradient, TAKE_FIRST, first * keep_first), fma(gradient * gradient, TAKE_SECOND, second * keep_second)


@kernel
def step_shard(
    memory: Any,
    chunk: int,
    visible: int,
    degree: int,
    factors: Any,
    factor_ints: Any,
    sh_rest: Any,
    pending: Any,
    size: Any,
    spread: Any,
    epsilon: Any,
) -> None:
    """Make the step after ``pending.step`` for the ``visible`` Gaussians whose factors begin at ``chunk``.

    That is p -= size * m / (spread * sqrt(v) + epsilon), after the steps that they have missed.
    """
    floats, _ = memory
    limit = (chunk + (visible - 1) // LANES) * CHUNK
    for begin in range(0, visible, LANES):
        start = (chunk + begin // LANES) * CHUNK
        direction_x, direction_y = load(factors, start + TO_X * LANES), load(factors, start + TO_Y * LANES)
        fill_basis(degree, direction_x, direction_y, load(factors, start + TO_Z * LANES), floats)
        for lane in range(min(LANES, visible - begin)):
            place = start + lane
            i = factor_ints[place + INDEX * LANES]
            numbers = i * REST
            red, green = factors[place + G_RED * LANES], factors[place + G_GREEN * LANES]
            gradient = outer_rest(load(floats, lane * LANES), red, green, factors[place + G_BLUE * LANES])
            ahead = factor_ints[min(place + CHUNK, limit) + INDEX * LANES] * REST
            for part in range(0, REST, LANES):
                prefetch(sh_rest, ahead + part)
                prefetch(pending.first, ahead + part)
                prefetch(pending.second, ahead + part)
            first, second = load_rest(pending.first, numbers), load_rest(pending.second, numbers)
            values = load_rest(sh_rest, numbers)
            keep_first, keep_second = KEEP_FIRST, KEEP_SECOND
            last = pending.last[i]
            if last != pending.step:
                values = _coasted(values, first, second, pending.drift[last])
                keep_first *= pending.first_decay[pending.step - last]
                keep_second *= pending.second_decay[pending.step - last]
            m0, v0 = _moments(first[0], second[0], gradient[0], keep_first, keep_second)
            m1, v1 = _moments(first[1], second[1], gradient[1], keep_first, keep_second)
            m2, v2 = _moments(first[2], second[2], gradient[2], keep_first, keep_second)
            moved = (
                values[0] - m0 * size / fma(square_root(v0), spread, epsilon),
                values[1] - m1 * size / fma(square_root(v1), spread, epsilon),
                values[2] - m2 * size / fma(square_root(v2), spread, epsilon),
            )
            store_rest(sh_rest, numbers, moved)
            store_rest(pending.first, numbers, (m0, m1, m2))
            store_rest(pending.second, numbers, (v0, v1, v2))
            pending.last[i] = pending.step + 1


class Factors:
    """The gradient of harmonics that the backward pass left; a `gsbench.gaussians.deferred.HarmonicsGradient`."""

    def __init__(
        self, runner: ShardRunner, memory: Tensor, chunks: list[int], visible: list[int], degree: int, count: int
    ) -> None:
        self._runner = runner
        self._memory = memory  # [chunks * CHUNK]
        self._chunks, self._visible = chunks, visible  # of each shard: its first chunk, how many Gaussians
        self._degree, self._count = degree, count

    def step(self, harmonics: DeferredHarmonics, rate: float, epsilon: float) -> None:
        pending = pending_of(harmonics)
        factors, values = self._memory.numpy(), harmonics.values.detach().numpy().reshape(-1)
        size = np.float32(rate / (1 - BETA1 ** (pending.step + 1)))
        spread = np.float32(1 / np.sqrt(1 - BETA2 ** (pending.step + 1)))

        def step(shard: int) -> None:
            step_shard(
                at.kernel_memory(),
                self._chunks[shard],
                self._visible[shard],
                self._degree,
                factors,
                factors.view(np.int32),
                values,
                pending,
                size,
                spread,
                np.float32(epsilon),
            )

        self._runner.run(len(self._chunks), step)

    def dense(self) -> Tensor:
        gradient = torch.zeros(self._count, NUM_SH_REST, 3)
        used = (self._degree + 1) ** 2 - 1
        for chunk, visible in zip(self._chunks, self._visible, strict=True):
            rows = self._memory[chunk * CHUNK :][: -(-visible // LANES) * CHUNK].reshape(-1, CHUNK // LANES, LANES)
            index = rows[:, INDEX].contiguous().view(torch.int32).reshape(-1)[:visible].long()  # [V]
            direction, color = (
                rows[:, part].transpose(1, 2).reshape(-1, 3)[:visible]  # [V, 3]
                for part in (slice(TO_X, TO_Z + 1), slice(G_RED, G_BLUE + 1))
            )
            functions = basis(direction, self._degree)[:, 1:, None]  # [V, K, 1]
            gradient[index, :used] = functions * color[:, None]
        return gradient
