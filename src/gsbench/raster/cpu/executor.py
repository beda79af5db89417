"""The compiled CPU rasterizer as an executor of the contract, and its bridge to autograd."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsbench.gaussians.deferred import DeferredHarmonics
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import CONSTANTS, RenderOutput
from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.jit import announce_compilation
from gsbench.raster.cpu.stages import Frame, Workshop, backward, footprint, forward
from gsbench.raster.cpu.workspace import ArenaPool
from gsbench.raster.footprint import Footprint
from gsbench.raster.validate import check_settings
from gsbench.scene.camera import Camera
from gsbench.system.resources import available_cores


class CpuRasterizer:
    """float32 on the CPU, compiled by numba at first use; the same bits on every run and for any number of ``threads``.

    Each render keeps its intermediate results until its graph is freed; memory is kept and used again. Safe to call
    from several threads.
    """

    name = "cpu"

    def __init__(self, threads: int | None = None) -> None:
        if threads is not None and threads < 1:
            raise ValueError(f"threads: must be at least 1, got {threads}")
        if CONSTANTS.tile != at.TILE:
            raise ValueError(f"the compiled rasterizer has tiles of {at.TILE} px, the contract {CONSTANTS.tile}")
        self.threads = threads or available_cores()
        self._workshop = Workshop(self.threads)
        self._frames = ArenaPool()
        self._scratch = ArenaPool()
        announce_compilation()

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_degree: int,
        background: Tensor,
        absolute_gradient: bool = False,
        splitting_matrix: bool = False,
    ) -> RenderOutput:
        """Render as ``raster.base.Rasterizer`` says. Raises ValueError naming the parameter that cannot be used."""
        return self._render(gaussians, None, camera, sh_degree, background, absolute_gradient, splitting_matrix)

    def render_deferred(
        self,
        gaussians: Gaussians,
        harmonics: DeferredHarmonics,
        camera: Camera,
        sh_degree: int,
        background: Tensor,
        absolute_gradient: bool = False,
        splitting_matrix: bool = False,
    ) -> RenderOutput:
        """Render as ``raster.base.DeferringRasterizer`` says."""
        return self._render(gaussians, harmonics, camera, sh_degree, background, absolute_gradient, splitting_matrix)

    def _render(
        self,
        gaussians: Gaussians,
        harmonics: DeferredHarmonics | None,
        camera: Camera,
        sh_degree: int,
        background: Tensor,
        absolute_gradient: bool,
        splitting_matrix: bool,
    ) -> RenderOutput:
        check_settings(gaussians, camera, sh_degree, background)
        if gaussians.means.dtype != torch.float32 or gaussians.means.device.type != "cpu":
            raise ValueError(
                f"means: raster=cpu needs float32 on the cpu, got {gaussians.means.dtype} on {gaussians.means.device}"
            )
        screen_points = torch.zeros(len(gaussians), 2, requires_grad=True)
        absolute = torch.zeros(len(gaussians), 2) if absolute_gradient else None
        probe = torch.zeros(len(gaussians), 3, 3, requires_grad=True) if splitting_matrix else None
        kept = _Kept()
        tensors = gaussians.tensors()
        if harmonics is not None:  # autograd does not see what is changed behind its back, and gets no gradient for
            tensors["sh_rest"] = tensors["sh_rest"].detach()
        image, alpha, radii = _Render.apply(
            self, kept, harmonics, camera, sh_degree, absolute, background, screen_points, probe, *tensors.values()
        )
        covered = partial(_footprint, self._workshop, kept, gaussians.map(torch.Tensor.detach), camera)
        return RenderOutput(image, alpha, radii, screen_points, absolute, covered, probe)


class _Holder:
    """Lives as long as a graph, or a question after its footprint; its arena goes back to the pool with it."""


class _Kept:
    """Values that a render keeps for the backward pass and for its footprint, and the hold on the memory of it."""

    frame: Frame
    holder: _Holder


def _footprint(
    workshop: Workshop, kept: _Kept, gaussians: Gaussians, camera: Camera, values: Tensor | None = None
) -> Footprint:
    """See ``raster.base.RenderOutput``; the frame's memory stays held as long as this can be asked for."""
    return footprint(workshop, kept.frame, gaussians, camera, values)


class _Render(torch.autograd.Function):
    """The bridge between the kernels and autograd."""

    @staticmethod
    def forward(
        ctx: Any,
        rasterizer: CpuRasterizer,
        kept: _Kept,
        harmonics: DeferredHarmonics | None,
        camera: Camera,
        degree: int,
        absolute: Tensor | None,
        background: Tensor,
        screen_points: Tensor,
        probe: Tensor | None,
        *tensors: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        gaussians = Gaussians(*(tensor.contiguous() for tensor in tensors))
        kept.holder = _Holder()
        arena = rasterizer._frames.lease(kept.holder)
        workshop = rasterizer._workshop
        image = workshop.tensors.empty((camera.height, camera.width, 3))
        alpha = workshop.tensors.empty((camera.height, camera.width))
        radii = torch.empty(len(gaussians), dtype=torch.int32)
        background_array = background.detach().contiguous().numpy()
        kept.frame = forward(
            workshop, arena, gaussians, harmonics, camera, degree, background_array, image, alpha, radii
        )
        ctx.rasterizer, ctx.kept, ctx.harmonics, ctx.absolute = rasterizer, kept, harmonics, absolute
        ctx.save_for_backward(alpha if ctx.needs_input_grad[6] else None, *gaussians.tensors().values())
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii)
        return image, alpha, radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_image: Tensor | None, g_alpha: Tensor | None, _: None) -> tuple[Tensor | None, ...]:
        alpha, *tensors = ctx.saved_tensors
        frame: Frame = ctx.kept.frame
        if g_image is None:
            g_image = torch.zeros(frame.view.height, frame.view.width, 3)
        g_image_array = g_image.contiguous().numpy().reshape(-1)
        g_alpha_array = np.empty(0, np.float32) if g_alpha is None else g_alpha.contiguous().numpy().reshape(-1)
        holder = _Holder()
        arena = ctx.rasterizer._scratch.lease(holder)
        try:
            gradients, g_screen, g_splitting = backward(
                ctx.rasterizer._workshop,
                arena,
                frame,
                Gaussians(*tensors),
                ctx.harmonics,
                g_image_array,
                g_alpha_array,
                ctx.absolute,
                ctx.needs_input_grad[8],
            )
        except BaseException:
            arena.drop("rows")  # it must be all zero, and an interrupt may have left sums in it
            raise
        g_background = None if alpha is None else (g_image * (1 - alpha).unsqueeze(-1)).sum((0, 1))
        return None, None, None, None, None, None, g_background, g_screen, g_splitting, *gradients
