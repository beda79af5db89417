"""The Triton rasterizer as an executor of the contract, and its stages in order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import CONSTANTS, RenderOutput
from gsbench.raster.footprint import Footprint, view_depths
from gsbench.raster.readback import Readback
from gsbench.raster.triton.backprojection import backproject, sum_units
from gsbench.raster.triton.binning import find_units, summarise, write_pairs
from gsbench.raster.triton.composite import composite, decomposite
from gsbench.raster.triton.footprint import cover, sum_cover
from gsbench.raster.triton.launch import launch, launch_grid
from gsbench.raster.triton.layout import BLOCK_PIXELS, RECORD, ROW, TILE, Grid, View, make_grid, make_view
from gsbench.raster.triton.memory import UNITS_AT_FIRST
from gsbench.raster.triton.projection import project
from gsbench.raster.triton.toolchain import load_driver
from gsbench.raster.triton.workspace import Workspace, WorkspacePool
from gsbench.raster.validate import check_settings, raise_for_values
from gsbench.scene.camera import Camera

MAX_INT16, MAX_INT32 = 2**15 - 1, 2**31 - 1


class TritonRasterizer:
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

    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        sh_degree: int,
        background: Tensor,
        absolute_gradient: bool = False,
    ) -> RenderOutput:
        """Render as ``raster.base.Rasterizer`` says. Raises ValueError naming the parameter that cannot be used."""
        check_settings(gaussians, camera, sh_degree, background)
        if gaussians.means.dtype != torch.float32:
            raise ValueError(f"means: raster=triton needs float32, got {gaussians.means.dtype}")
        if gaussians.means.device.type == "cuda":
            load_driver()
        screen_points = torch.zeros_like(gaussians.means[:, :2], requires_grad=True)
        absolute = torch.zeros_like(screen_points) if absolute_gradient else None
        kept = _Kept()
        image, alpha, radii = _Render.apply(
            self, kept, camera, sh_degree, absolute, background, screen_points, *gaussians.tensors().values()
        )
        footprint = partial(_footprint, self, kept, gaussians.map(Tensor.detach), camera)
        return RenderOutput(image, alpha, radii, screen_points, absolute, footprint)


@dataclass
class _Frame:
    """What the forward pass leaves for the backward pass; the memory belongs to a workspace."""

    grid: Grid
    view: View
    degree: int
    units: int
    pairs: int
    records: Tensor  # [N + 1, 16] the last cannot be seen
    row_counts: Tensor  # [N] int32 units of each Gaussian
    first_units: Tensor  # [N] int64
    unit_widths: Tensor  # [units] int32 pairs of each unit
    unit_blocks: Tensor  # [units] int32 the first block of each
    pair_ends: Tensor  # [units] int64 running sum of them
    order: Tensor  # [blocks] int64 the longest lists first
    starts: Tensor  # [blocks + 1] int32
    entries: Tensor  # [pairs] int32 Gaussians, by block, front to back
    slots: Tensor  # [pairs] int64 of each entry
    transmittance: Tensor  # [blocks * BLOCK_PIXELS]
    last: Tensor  # [blocks * BLOCK_PIXELS] int32
    past: Tensor  # [blocks] int32
    last_slots: Tensor  # [blocks] int64


def _forward(
    frame_memory: Workspace,
    scratch: Workspace,
    gaussians: Gaussians,
    camera: Camera,
    degree: int,
    background: Tensor,
    image: Tensor,
    alpha: Tensor,
    radii: Tensor,
) -> _Frame:
    """Project, sort, bin, composite into ``image``, ``alpha`` and ``radii``."""
    grid, view = make_grid(camera), make_view(camera)
    count, blocks = len(gaussians), grid.blocks
    records = frame_memory.take("records", (count + 1) * RECORD.value, torch.float32)
    row_counts = frame_memory.take("row_counts", count, torch.int32)
    keys = scratch.take("depth_keys", count, torch.int32)
    flags = scratch.take("flags", 1, torch.int32).zero_()
    record_ints = records.view(torch.int32)
    parameters = [tensor.detach() for tensor in gaussians.tensors().values()]
    launch(project, count + 1, 128)(
        *parameters, count, view, records, record_ints, keys, row_counts, radii, flags, DEGREE=degree
    )

    depth_order = scratch.take("depth_order", count, torch.int64)
    torch.sort(keys, stable=True, out=(scratch.take("sorted_depths", count, torch.int32), depth_order))
    unit_ends = scratch.take("unit_ends", count, torch.int64)
    torch.cumsum(row_counts[depth_order], 0, out=unit_ends)
    first_units = frame_memory.take("first_units", count, torch.int64)

    capacity = max(frame_memory.capacity("unit_widths"), UNITS_AT_FIRST * count, 1)
    while True:
        owners = scratch.take("unit_owners", capacity, torch.int32)
        first_blocks = frame_memory.take("unit_blocks", capacity, torch.int32)
        widths = frame_memory.take("unit_widths", capacity, torch.int32).zero_()
        pair_ends = frame_memory.take("pair_ends", capacity, torch.int64)
        launch(find_units, count, 128)(
            depth_order,
            count,
            row_counts,
            unit_ends,
            records,
            record_ints,
            grid.blocks_x,
            capacity,
            first_units,
            owners,
            first_blocks,
            widths,
        )
        torch.cumsum(widths, 0, out=pair_ends)
        status = scratch.take("status", 3, torch.int64)
        launch_grid(summarise, 1)(unit_ends, count, pair_ends, capacity, flags, background, status)
        units, pairs, bad = Readback(status).values().tolist()  # the one wait for the device
        if bad:
            raise_for_values(gaussians, background)
        if units <= capacity:
            break
        capacity = 2 * units
    if pairs > MAX_INT32:
        raise ValueError(f"gaussians: {pairs} (Gaussian, block) pairs in one view are more than {MAX_INT32}")

    key_type = torch.int16 if blocks <= MAX_INT16 else torch.int32
    block_keys = scratch.take(f"block_keys_{key_type}", pairs, key_type)
    sorted_keys = scratch.take(f"sorted_keys_{key_type}", pairs, key_type)
    slot_owners = scratch.take("slot_owners", pairs, torch.int32)
    launch(write_pairs, units, 128)(owners, first_blocks, widths, pair_ends, units, block_keys, slot_owners)
    slots = frame_memory.take("slots", pairs, torch.int64)
    torch.sort(block_keys, stable=True, out=(sorted_keys, slots))
    entries = frame_memory.take("entries", pairs, torch.int32)
    torch.index_select(slot_owners, 0, slots, out=entries)
    starts = frame_memory.take("starts", blocks + 1, torch.int32)
    numbers = torch.arange(blocks + 1, dtype=key_type, device=image.device)
    torch.searchsorted(sorted_keys, numbers, out_int32=True, out=starts)
    order = frame_memory.take("order", blocks, torch.int64)
    lengths = scratch.take("sorted_lengths", blocks, torch.int32)
    torch.sort(starts[1:] - starts[:-1], descending=True, stable=True, out=(lengths, order))

    frame = _Frame(
        grid,
        view,
        degree,
        units,
        pairs,
        records,
        row_counts,
        first_units,
        widths,
        first_blocks,
        pair_ends,
        order,
        starts,
        entries,
        slots,
        frame_memory.take("transmittance", blocks * BLOCK_PIXELS.value, torch.float32),
        frame_memory.take("last", blocks * BLOCK_PIXELS.value, torch.int32),
        frame_memory.take("past", blocks, torch.int32),
        frame_memory.take("last_slots", blocks, torch.int64),
    )
    launch_grid(composite, blocks)(
        order,
        starts,
        entries,
        records,
        count,
        background,
        grid.width,
        grid.height,
        grid.blocks_x,
        image,
        alpha,
        frame.transmittance,
        frame.last,
        frame.past,
        slots,
        frame.last_slots,
        num_warps=1,
    )
    return frame


def _sum_units(frame: _Frame, rows: Tensor) -> None:
    launch(sum_units, frame.units, 32)(
        frame.pair_ends, frame.unit_widths, frame.unit_blocks, frame.last_slots, frame.units, rows
    )


def _backward(
    scratch: Workspace,
    frame: _Frame,
    gaussians: Gaussians,
    background: Tensor,
    g_image: Tensor,
    g_alpha: Tensor | None,
    absolute: Tensor | None,
) -> tuple[list[Tensor], Tensor]:
    """The gradients of the six tensors and of ``screen_points``; fills ``absolute`` [N, 2] if it is given."""
    grid, count = frame.grid, len(gaussians)
    rows = scratch.take("rows", frame.pairs * ROW.value, torch.float32)
    launch_grid(decomposite, grid.blocks)(
        frame.order,
        frame.starts,
        frame.entries,
        frame.slots,
        frame.records,
        count,
        background,
        grid.width,
        grid.height,
        grid.blocks_x,
        frame.transmittance,
        frame.last,
        frame.past,
        g_image,
        g_image if g_alpha is None else g_alpha,
        rows,
        HAS_ALPHA=g_alpha is not None,
        ABSOLUTE=absolute is not None,
        num_warps=1,
    )
    _sum_units(frame, rows)
    means, log_scales, quaternions, logits, _, sh_rest = gaussians.tensors().values()
    gradients = [torch.zeros_like(tensor) for tensor in gaussians.tensors().values()]
    g_screen = torch.zeros_like(means[:, :2])
    launch(backproject, count, 128)(
        means,
        log_scales,
        quaternions,
        logits,
        sh_rest,
        count,
        frame.view,
        frame.records.view(torch.int32),
        frame.row_counts,
        frame.first_units,
        frame.pair_ends,
        frame.unit_widths,
        rows,
        *gradients,
        g_screen,
        g_screen if absolute is None else absolute,
        DEGREE=frame.degree,
        ABSOLUTE=absolute is not None,
    )
    return gradients, g_screen


def _footprint(
    rasterizer: TritonRasterizer, kept: _Kept, gaussians: Gaussians, camera: Camera, values: Tensor | None = None
) -> Footprint:
    """See ``raster.base.RenderOutput``."""
    frame, count, device = kept.frame, len(gaussians), gaussians.means.device
    covered = torch.zeros(count, dtype=torch.int32, device=device)
    sums, distances = torch.zeros(2, count, device=device)
    asked = sums if values is None else values.detach().float().contiguous()
    holder = _Holder()
    with torch.cuda.device_of(covered):
        scratch = rasterizer._scratch.lease(holder, device)
        rows = scratch.take("rows", frame.pairs * ROW.value, torch.float32)  # ``cover`` fills three of 16
        launch_grid(cover, frame.grid.blocks)(
            frame.starts,
            frame.entries,
            frame.slots,
            frame.records,
            frame.grid.width,
            frame.grid.height,
            frame.grid.blocks_x,
            frame.last,
            frame.past,
            asked,
            rows,
            HAS_VALUES=values is not None,
            num_warps=1,
        )
        _sum_units(frame, rows)
        launch(sum_cover, count, 128)(
            count,
            frame.row_counts,
            frame.first_units,
            frame.pair_ends,
            frame.unit_widths,
            rows,
            covered,
            sums,
            distances,
        )
    return Footprint(covered, view_depths(gaussians, camera), sums, distances)


class _Holder:
    """Lives as long as a graph, or a question after its footprint; its workspace goes back to the pool with it."""


class _Kept:
    """What a render keeps for the backward pass and for its footprint, and the hold on the memory of it."""

    frame: _Frame
    holder: _Holder


class _Render(torch.autograd.Function):
    """The bridge between the kernels and autograd. Nothing that it keeps refers back to it."""

    @staticmethod
    def forward(
        ctx: Any,
        rasterizer: TritonRasterizer,
        kept: _Kept,
        camera: Camera,
        degree: int,
        absolute: Tensor | None,
        background: Tensor,
        screen_points: Tensor,
        *tensors: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        gaussians = Gaussians(*(tensor.contiguous() for tensor in tensors))
        background, device = background.contiguous(), background.device
        kept.holder, scratch_holder = _Holder(), _Holder()
        image = torch.empty(camera.height, camera.width, 3, dtype=torch.float32, device=device)
        alpha = torch.empty(camera.height, camera.width, dtype=torch.float32, device=device)
        radii = torch.empty(len(gaussians), dtype=torch.int32, device=device)
        with torch.cuda.device_of(background):
            memory = rasterizer._frames.lease(kept.holder, device)
            scratch = rasterizer._scratch.lease(scratch_holder, device)
            kept.frame = _forward(memory, scratch, gaussians, camera, degree, background, image, alpha, radii)
        ctx.rasterizer, ctx.kept, ctx.absolute = rasterizer, kept, absolute
        opacity = alpha if ctx.needs_input_grad[5] else None
        ctx.save_for_backward(opacity, background, *gaussians.tensors().values())
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii)
        return image, alpha, radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_image: Tensor | None, g_alpha: Tensor | None, _: None) -> tuple[Tensor | None, ...]:
        alpha, background, *tensors = ctx.saved_tensors
        grid: Grid = ctx.kept.frame.grid
        if g_image is None:
            g_image = background.new_zeros(grid.height, grid.width, 3)
        g_image = g_image.contiguous()
        g_alpha = None if g_alpha is None else g_alpha.contiguous()
        holder = _Holder()
        with torch.cuda.device_of(background):
            scratch = ctx.rasterizer._scratch.lease(holder, background.device)
            gradients, g_screen = _backward(
                scratch, ctx.kept.frame, Gaussians(*tensors), background, g_image, g_alpha, ctx.absolute
            )
        g_background = None if alpha is None else (g_image * (1 - alpha).unsqueeze(-1)).sum((0, 1))
        return None, None, None, None, None, g_background, g_screen, *gradients
