"""The Triton rasterizer as an executor of the contract."""

from __future__ import annotations

import torch
from torch import Tensor

from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import CONSTANTS
from gsbench.raster.footprint import Footprint
from gsbench.raster.staged import Gradients, Holder, Request, StagedRasterizer
from gsbench.raster.triton.layout import TILE
from gsbench.raster.triton.stages import Frame, backward, footprint, forward
from gsbench.raster.triton.toolchain import load_driver
from gsbench.raster.triton.workspace import WorkspacePool
from gsbench.scene.camera import Camera


class TritonRasterizer(StagedRasterizer[Frame]):
    """float32 on a GPU, compiled by Triton at first use; the same bits on every run of one GPU.

    Each render keeps its intermediate results until its graph is freed; memory is kept and used again. A render makes
    the host wait for the device once, to learn how much there is to composite.
    """

    name = "triton"

    def __init__(self) -> None:
        if CONSTANTS.tile != TILE.value:
            raise ValueError(f"the Triton rasterizer has tiles of {TILE.value} px, the contract {CONSTANTS.tile}")
        self._frames = WorkspacePool()
        self._scratch = WorkspacePool()

    def check(self, gaussians: Gaussians) -> None:
        """Raise ValueError where tensors are not float32, or the device's driver cannot be loaded."""
        if gaussians.means.dtype != torch.float32:
            raise ValueError(f"means: raster=triton needs float32, got {gaussians.means.dtype}")
        if gaussians.means.device.type == "cuda":
            load_driver()

    def forward(self, holder: Holder, gaussians: Gaussians, request: Request) -> tuple[Tensor, Tensor, Tensor, Frame]:
        """See `StagedRasterizer`."""
        camera, device = request.camera, gaussians.means.device
        image = torch.empty(camera.height, camera.width, 3, dtype=torch.float32, device=device)
        alpha = torch.empty(camera.height, camera.width, dtype=torch.float32, device=device)
        radii = torch.empty(len(gaussians), dtype=torch.int32, device=device)
        while_drawn = Holder()
        with torch.cuda.device_of(image):
            memory = self._frames.lease(holder, device)
            scratch = self._scratch.lease(while_drawn, device)
            return image, alpha, radii, forward(memory, scratch, gaussians, request, image, alpha, radii)

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
        holder = Holder()
        with torch.cuda.device_of(g_image):
            scratch = self._scratch.lease(holder, g_image.device)
            return backward(scratch, frame, gaussians, request, g_image, g_alpha, want_splitting)

    def footprint(self, frame: Frame, gaussians: Gaussians, camera: Camera, values: Tensor | None = None) -> Footprint:
        """See ``raster.base.RenderOutput``."""
        holder = Holder()
        with torch.cuda.device_of(gaussians.means):
            scratch = self._scratch.lease(holder, gaussians.means.device)
            return footprint(scratch, frame, gaussians, camera, values)
