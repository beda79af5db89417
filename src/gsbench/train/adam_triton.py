"""Adam in one Triton kernel for each parameter. Results have the same bits on every run.

torch's fused kernel reaches half of the memory's throughput on an H100 (docs/measurements.md).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsbench.gaussians.paper_values import ADAM_BETAS, ADAM_EPSILON
from gsbench.gaussians.trainable import Update
from gsbench.raster.staged import upload
from gsbench.raster.triton.launch import launch

NUMBERS = 1024  # of a parameter per program
BETA1, BETA2 = (tl.constexpr(beta) for beta in ADAM_BETAS)
EPSILON = tl.constexpr(ADAM_EPSILON)


@triton.jit(do_not_specialize=["count"])
def adam_step(
    values,
    gradients,
    further,
    first,
    second,
    factors,
    seen,
    visible,
    count,
    WIDTH: tl.constexpr,
    ACTIVE: tl.constexpr,
    HAS_FURTHER: tl.constexpr,
    HAS_SEEN: tl.constexpr,
    HAS_VISIBLE: tl.constexpr,
    GROUP: tl.constexpr,
):
    """Apply Adam (Kingma and Ba 2015, algorithm 1) to ``values`` [count, WIDTH], in place.

    ``first`` and ``second`` are the moments, ``factors`` [2] `ParameterState.factors`. The gradient
    is 0 from column ``ACTIVE`` on and, if ``HAS_SEEN``, where ``seen`` [count] is 0; ``gradients``
    is not read there and may be undefined. If ``HAS_FURTHER``, ``further`` is added to it. If
    ``HAS_VISIBLE``, rows where ``visible`` [count] is 0 do not change.
    """
    place = tl.program_id(0).to(tl.int64) * GROUP + tl.arange(0, GROUP)  # [GROUP]
    inside = place < count.to(tl.int64) * WIDTH
    if HAS_VISIBLE:
        inside &= tl.load(visible + place // WIDTH, mask=inside, other=0) != 0
    read = inside
    if HAS_SEEN:
        read &= tl.load(seen + place // WIDTH, mask=inside, other=0) > 0
    if ACTIVE < WIDTH:
        read &= place % WIDTH < ACTIVE
    g = tl.load(gradients + place, mask=read, other=0.0)
    if HAS_FURTHER:
        g += tl.load(further + place, mask=inside, other=0.0)
    m = BETA1 * tl.load(first + place, mask=inside, other=0.0) + (1 - BETA1) * g
    v = BETA2 * tl.load(second + place, mask=inside, other=0.0) + (1 - BETA2) * (g * g)
    value = tl.load(values + place, mask=inside, other=0.0)
    step = tl.load(factors) * m / (tl.sqrt(v) * tl.load(factors + 1) + EPSILON)
    tl.store(first + place, m, mask=inside)
    tl.store(second + place, v, mask=inside)
    tl.store(values + place, value - step, mask=inside)


class TritonAdam:
    """Adam for `TrainableGaussians` on a GPU; see `gsbench.gaussians.trainable.StepAll`."""

    def __call__(
        self, updates: Sequence[Update], seen: Tensor | None = None, visible: Tensor | None = None
    ) -> None:
        """Apply Adam; the host does not wait."""
        if updates:
            numbers = [x for update in updates for x in update.state.factors]
            factors = upload(numbers, updates[0].parameter.device).view(-1, 2)
            self.launch(updates, factors, seen, visible)

    def launch(
        self,
        updates: Sequence[Update],
        factors: Tensor,
        seen: Tensor | None,
        visible: Tensor | None,
    ) -> None:
        """Apply Adam with ``factors`` [updates, 2] in the memory of the device."""
        with torch.cuda.device_of(factors):
            for (parameter, gradient, state, active, further), own in zip(
                updates, factors.unbind(), strict=True
            ):
                # An input that is not there has no memory; its pointer is any other, not used.
                width = parameter.shape[1:].numel()
                launch(adam_step, parameter.numel(), NUMBERS)(
                    values=parameter.detach(),
                    gradients=gradient,
                    further=gradient if further is None else further,
                    first=state.first,
                    second=state.second,
                    factors=own,
                    seen=gradient if seen is None else seen,
                    visible=gradient if visible is None else visible,
                    count=len(parameter),
                    WIDTH=width,
                    ACTIVE=width if active is None else active,
                    HAS_FURTHER=further is not None,
                    HAS_SEEN=seen is not None,
                    HAS_VISIBLE=visible is not None,
                )
