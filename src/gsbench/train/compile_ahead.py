"""Compilation of the kernels of raster=triton side by side, before the first of them runs.

A kernel is otherwise compiled when it is first launched, one after the other on one core.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import torch
import triton

from gsbench.gaussians.trainable import ParameterState, Update
from gsbench.raster.contract import Case
from gsbench.raster.staged import Lifetime, RenderRequest
from gsbench.raster.triton.executor import (
    EXTRA_KERNELS,
    TritonRasterizer,
    camera_numbers,
    fresh_on,
    zeros_like_all,
)
from gsbench.raster.triton.launch import Workspace, only_compiled
from gsbench.raster.triton.lists import Room
from gsbench.train.adam_triton import TritonAdam
from gsbench.train.loss import SSIM_WEIGHT
from gsbench.train.loss_triton import TritonLoss

DEGREES = (3, 2, 1, 0)  # of harmonics; the longest compilations first


def compile_ahead(rasterizer: TritonRasterizer, device: torch.device) -> None:
    """Compile the kernels of training steps for ``device``, in threads; run none.

    With a Triton that cannot compile in threads (before 3.5), do nothing.
    """
    if not hasattr(triton, "AsyncCompileMode"):
        return
    with (
        ThreadPoolExecutor(os.cpu_count()) as pool,
        triton.AsyncCompileMode(pool),
        only_compiled(),
    ):
        for degree in DEGREES:
            for extended in (True, False):
                _launch_step(rasterizer, device, degree, extended)


def _launch_step(
    rasterizer: TritonRasterizer, device: torch.device, degree: int, extended: bool
) -> None:
    """Launch a training step; if ``extended``, with all outputs and inputs that it can have."""
    case = Case(8, 8, 20, sh_degree=degree)
    values = case.gaussians().map(lambda tensor: tensor.to(device, torch.float32))
    rasterizer.check(values)
    black, fresh, memory = torch.zeros(3, device=device), fresh_on(device), Workspace(device)
    request = RenderRequest(
        case.camera(),
        degree,
        black,
        torch.zeros(case.count, 2, device=device) if extended else None,
        next(iter(EXTRA_KERNELS)) if extended else None,
        Lifetime(),
    )
    view = camera_numbers(case.camera(), device)
    started = rasterizer.start(values, request, view, memory, memory, 1, fresh)
    image, alpha, _, frame = rasterizer.finish(started, Room(1, 1))
    some = alpha if extended else None
    gradients = zeros_like_all(values)
    rasterizer.differentiate(frame, values, request, image, some, memory, fresh, gradients)
    rasterizer.footprint(frame, values, request, some)

    loss, target = TritonLoss(SSIM_WEIGHT), image if extended else image.to(torch.uint8)
    measured = loss.measure(image, target, fresh("losses", (3,), torch.float32), memory, True)
    loss.differentiate(measured, black[0], image)

    updates = []
    for tensor, gradient in zip(values.tensors().values(), gradients, strict=True):
        state = ParameterState(0.1, 1, {"first": gradient, "second": gradient})
        active = 3 * ((degree + 1) ** 2 - 1) if tensor.dim() == 3 else None
        updates.append(Update(tensor, gradient, state, active, gradient if extended else None))
    adam, seen = TritonAdam(), frame.projected.row_counts
    adam(updates, seen, seen if extended else None)
    adam(updates)
