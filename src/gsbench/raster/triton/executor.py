"""The Triton rasterizer: the stages of the forward and the backward pass, and the footprint."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import CONSTANTS, CameraNumbers, Footprint, view_depths
from gsbench.raster.executors import load_driver
from gsbench.raster.staged import Gradients, Lifetime, RenderRequest, StagedRasterizer
from gsbench.raster.triton.composite import composite, composite_backward, cover, sum_cover
from gsbench.raster.triton.launch import Workspace, WorkspacePool, launch, launch_grid
from gsbench.raster.triton.layout import (
    BLOCK_HEIGHT,
    BLOCK_PIXELS,
    BLOCK_WIDTH,
    BORDER,
    COLOR_SLOPES,
    RECORD,
    ROW,
    TILE,
    count_borders,
)
from gsbench.raster.triton.lists import Lists, Projected, Units, find_all_units, make_lists
from gsbench.raster.triton.projection import backproject, project, sum_units


@dataclass
class TritonFrame:
    """Results of the forward pass for the backward pass; the memory belongs to a workspace."""

    blocks_x: int
    blocks: int  # number of blocks
    view: CameraNumbers
    projected: Projected
    units: Units
    lists: Lists
    transmittance: Tensor  # [blocks * BLOCK_PIXELS]
    last: Tensor  # [blocks * BLOCK_PIXELS] int32
    past: Tensor  # [blocks] int32; see `composite` for these five
    borders: Tensor  # [count_borders(pairs) * BORDER]
    last_slots: Tensor  # [blocks] int64


class TritonRasterizer(StagedRasterizer[TritonFrame]):
    """A rasterizer in float32 on a GPU, compiled by Triton at first use.

    Results have the same bits on every run on one GPU. Each render keeps its intermediate results
    until its graph is freed; then their memory is reused. A render waits for the device once, for
    the sizes of the lists.
    """

    name = "triton"

    def __init__(self) -> None:
        if CONSTANTS.tile != TILE.value:
            raise ValueError(
                f"the Triton rasterizer has tiles of {TILE.value} px, the contract {CONSTANTS.tile}"
            )
        self._frames = WorkspacePool()
        self._scratch = WorkspacePool()

    def check(self, gaussians: Gaussians) -> None:
        """Raise ValueError unless tensors are float32; InputError if Triton cannot use the GPU."""
        if gaussians.means.dtype != torch.float32:
            raise ValueError(f"means: raster=triton needs float32, got {gaussians.means.dtype}")
        if gaussians.means.device.type == "cuda":
            load_driver()

    def forward(
        self, gaussians: Gaussians, request: RenderRequest
    ) -> tuple[Tensor, Tensor, Tensor, TritonFrame]:
        """Project, sort, bin, composite; see `StagedRasterizer`.

        Raises ValueError for bad values.
        """
        camera, device = request.camera, gaussians.means.device
        image = torch.empty(camera.height, camera.width, 3, dtype=torch.float32, device=device)
        alpha = torch.empty(camera.height, camera.width, dtype=torch.float32, device=device)
        radii = torch.empty(len(gaussians), dtype=torch.int32, device=device)
        call_lifetime = Lifetime()  # freed when this call returns
        with torch.cuda.device_of(image):
            memory = self._frames.lease(request.lifetime, device)
            scratch = self._scratch.lease(call_lifetime, device)
            # No number is an integer: Triton compiles a kernel again for the integer 1 and for
            # multiples of 16.
            view = CameraNumbers._make(map(float, CameraNumbers.of(camera)))
            blocks_x = -(-camera.width // BLOCK_WIDTH.value)
            blocks = blocks_x * -(-camera.height // BLOCK_HEIGHT.value)
            count, background = len(gaussians), request.background
            flags = scratch.take("flags", 1, torch.int32).zero_()
            keys = scratch.take("depth_keys", count, torch.int32)
            projected = _project(memory, gaussians, view, request.degree, keys, radii, flags)
            units, owners = find_all_units(
                memory, scratch, gaussians, projected, blocks_x, keys, flags, background
            )
            lists = make_lists(memory, scratch, units, owners, blocks)
            frame = TritonFrame(
                blocks_x,
                blocks,
                view,
                projected,
                units,
                lists,
                memory.take("transmittance", blocks * BLOCK_PIXELS.value, torch.float32),
                memory.take("last", blocks * BLOCK_PIXELS.value, torch.int32),
                memory.take("past", blocks, torch.int32),
                memory.take("borders", count_borders(units.pairs) * BORDER.value, torch.float32),
                memory.take("last_slots", blocks, torch.int64),
            )
            launch_grid(composite, blocks)(
                lists.order,
                lists.starts,
                lists.entries,
                projected.records,
                count,
                background,
                camera.width,
                camera.height,
                blocks_x,
                image,
                alpha,
                frame.transmittance,
                frame.last,
                frame.past,
                frame.borders,
                lists.slots,
                frame.last_slots,
                num_warps=1,
            )
            return image, alpha, radii, frame

    def backward(
        self,
        frame: TritonFrame,
        gaussians: Gaussians,
        request: RenderRequest,
        g_image: Tensor,
        g_alpha: Tensor | None,
        want_splitting: bool,
    ) -> Gradients:
        """See `StagedRasterizer`."""
        lifetime = Lifetime()
        with torch.cuda.device_of(g_image):
            scratch = self._scratch.lease(lifetime, g_image.device)
            camera, units, lists, count = request.camera, frame.units, frame.lists, len(gaussians)
            projected, absolute = frame.projected, request.absolute
            rows = scratch.take("rows", units.pairs * ROW.value, torch.float32)
            inner = count_borders(units.pairs)
            launch_grid(composite_backward, inner + frame.blocks)(
                lists.order,
                lists.starts,
                frame.blocks,
                inner,
                lists.entries,
                lists.slots,
                projected.records,
                count,
                request.background,
                camera.width,
                camera.height,
                frame.blocks_x,
                frame.transmittance,
                frame.last,
                frame.past,
                frame.borders,
                g_image,
                g_image if g_alpha is None else g_alpha,
                rows,
                HAS_ALPHA=g_alpha is not None,
                ABSOLUTE=absolute is not None,
                num_warps=1,
            )
            _sum_units(frame, rows)
            means, log_scales, quaternions, logits, *_ = gaussians.tensors().values()
            gradients = [torch.zeros_like(tensor) for tensor in gaussians.tensors().values()]
            g_screen = torch.zeros_like(means[:, :2])
            g_splitting = means.new_zeros(count, 3, 3) if want_splitting else None
            launch(backproject, count, 128)(
                means,
                log_scales,
                quaternions,
                logits,
                count,
                frame.view,
                projected.records.view(torch.int32),
                projected.color_slopes,
                projected.row_counts,
                units.first,
                units.pair_ends,
                units.widths,
                rows,
                *gradients,
                g_screen,
                g_screen if absolute is None else absolute,
                g_screen if g_splitting is None else g_splitting,
                DEGREE=request.degree,
                ABSOLUTE=absolute is not None,
                SPLITTING=want_splitting,
            )
            return Gradients(gradients, g_screen, g_splitting)

    def footprint(
        self,
        frame: TritonFrame,
        gaussians: Gaussians,
        request: RenderRequest,
        values: Tensor | None = None,
    ) -> Footprint:
        """See ``raster.base.RenderOutput``."""
        lifetime = Lifetime()
        with torch.cuda.device_of(gaussians.means):
            scratch = self._scratch.lease(lifetime, gaussians.means.device)
            units = frame.units
            lists = frame.lists
            count = len(gaussians)
            device = gaussians.means.device
            covered = torch.zeros(count, dtype=torch.int32, device=device)
            sums, distances = torch.zeros(2, count, device=device)
            given = sums if values is None else values.detach().float().contiguous()
            # ``cover`` fills 3 of 16 columns
            rows = scratch.take("rows", units.pairs * ROW.value, torch.float32)
            launch_grid(cover, frame.blocks)(
                lists.starts,
                lists.entries,
                lists.slots,
                frame.projected.records,
                request.camera.width,
                request.camera.height,
                frame.blocks_x,
                frame.last,
                frame.past,
                given,
                rows,
                HAS_VALUES=values is not None,
                num_warps=1,
            )
            _sum_units(frame, rows)
            launch(sum_cover, count, 128)(
                count,
                frame.projected.row_counts,
                units.first,
                units.pair_ends,
                units.widths,
                rows,
                covered,
                sums,
                distances,
            )
            return Footprint(covered, view_depths(gaussians, request.camera), sums, distances)


def _project(
    memory: Workspace,
    gaussians: Gaussians,
    view: CameraNumbers,
    degree: int,
    keys: Tensor,
    radii: Tensor,
    flags: Tensor,
) -> Projected:
    """Project all Gaussians; fill ``keys``, ``radii`` and ``flags``.

    Gaussians are sorted by ``keys``. ``flags`` is 1 if a value is bad.
    """
    count = len(gaussians)
    projected = Projected(
        memory.take("records", (count + 1) * RECORD.value, torch.float32),
        memory.take("color_slopes", count * COLOR_SLOPES.value, torch.float32),
        memory.take("row_counts", count, torch.int32),
    )
    parameters = [tensor.detach() for tensor in gaussians.tensors().values()]
    launch(project, count + 1, 128)(
        *parameters,
        count,
        view,
        projected.records,
        projected.records.view(torch.int32),
        projected.color_slopes,
        keys,
        projected.row_counts,
        radii,
        flags,
        DEGREE=degree,
    )
    return projected


def _sum_units(frame: TritonFrame, rows: Tensor) -> None:
    """Sum the ``rows`` of the pairs of each unit, in place."""
    units = frame.units
    launch(sum_units, units.number, 32)(
        units.pair_ends, units.widths, units.blocks, frame.last_slots, units.number, rows
    )
