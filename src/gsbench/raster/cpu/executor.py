"""The compiled CPU rasterizer as an executor of the contract."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import CONSTANTS
from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.stages import Frame, Workshop, backward, footprint, forward
from gsbench.raster.cpu.workspace import ArenaPool
from gsbench.raster.footprint import Footprint
from gsbench.raster.staged import Gradients, Holder, Request, StagedRasterizer
from gsbench.scene.camera import Camera
from gsbench.system.resources import available_cores


class CpuRasterizer(StagedRasterizer[Frame]):
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

    def check(self, gaussians: Gaussians) -> None:
        """Raise ValueError where tensors are not float32 on the CPU."""
        means = gaussians.means
        if means.dtype != torch.float32 or means.device.type != "cpu":
            raise ValueError(f"means: raster=cpu needs float32 on the cpu, got {means.dtype} on {means.device}")

    def forward(self, holder: Holder, gaussians: Gaussians, request: Request) -> tuple[Tensor, Tensor, Tensor, Frame]:
        """See `StagedRasterizer`."""
        camera, tensors = request.camera, self._workshop.tensors
        image = tensors.empty((camera.height, camera.width, 3))
        alpha = tensors.empty((camera.height, camera.width))
        radii = torch.empty(len(gaussians), dtype=torch.int32)
        arena = self._frames.lease(holder)
        return image, alpha, radii, forward(self._workshop, arena, gaussians, request, image, alpha, radii)

    def backward(
        self,
        frame: Frame,
        gaussians: Gaussians,
        request: Request,
        g_image: Tensor,
        g_alpha: Tensor | None,
        want_splitting: bool,
    ) -> Gradients:
        """See `StagedRasterizer`."""
        g_alpha_array = np.empty(0, np.float32) if g_alpha is None else g_alpha.numpy().reshape(-1)
        holder = Holder()
        arena = self._scratch.lease(holder)
        try:
            return backward(
                self._workshop,
                arena,
                frame,
                gaussians,
                request,
                g_image.numpy().reshape(-1),
                g_alpha_array,
                want_splitting,
            )
        except BaseException:
            arena.drop("rows")  # it must be all zero, and an interrupt may have left sums in it
            raise

    def footprint(self, frame: Frame, gaussians: Gaussians, camera: Camera, values: Tensor | None = None) -> Footprint:
        """See ``raster.base.RenderOutput``."""
        return footprint(self._workshop, frame, gaussians, camera, values)
