"""The Triton rasterizer as an executor of the contract, and its stages in order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsbench.gaussians.deferred import Coasting, DeferredHarmonics
from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import CONSTANTS, RenderOutput
from gsbench.raster.footprint import Footprint, view_depths
from gsbench.raster.readback import Readback
from gsbench.raster.triton.backprojection import backproject, sum_units
from gsbench.raster.triton.binning import find_units, summarise, write_pairs
from gsbench.raster.triton.composite import composite, decomposite
from gsbench.raster.triton.deferred import Factors, Pending, Tables
from gsbench.raster.triton.footprint import cover, sum_cover
from gsbench.raster.triton.launch import launch, launch_grid
from gsbench.raster.triton.layout import (
    BLOCK_PIXELS,
    BORDER,
    COLOR_SLOPES,
    FACTORS,
    RECORD,
    ROW,
    TILE,
    Grid,
    View,
    count_borders,
    make_grid,
    make_view,
)
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
        self._tables: WeakKeyDictionary[Coasting, Tables] = WeakKeyDictionary()

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
        if gaussians.means.dtype != torch.float32:
            raise ValueError(f"means: raster=triton needs float32, got {gaussians.means.dtype}")
        if gaussians.means.device.type == "cuda":
            load_driver()
        screen_points = torch.zeros_like(gaussians.means[:, :2], requires_grad=True)
        absolute = torch.zeros_like(screen_points) if absolute_gradient else None
        probe = screen_points.new_zeros(len(gaussians), 3, 3, requires_grad=True) if splitting_matrix else None
        kept = _Kept()
        tensors = gaussians.tensors()
        if harmonics is not None:  # autograd does not see what is changed behind its back, and gets no gradient for
            tensors["sh_rest"] = tensors["sh_rest"].detach()
        image, alpha, radii = _Render.apply(
            self, kept, harmonics, camera, sh_degree, absolute, background, screen_points, probe, *tensors.values()
        )
        footprint = partial(_footprint, self, kept, gaussians.map(Tensor.detach), camera)
        return RenderOutput(image, alpha, radii, screen_points, absolute, footprint, probe)

    def _pending(self, harmonics: DeferredHarmonics | None) -> Pending:
        if harmonics is None:
            return Pending(None, None)
        tables = self._tables.setdefault(harmonics.coasting, Tables(harmonics.values.device))
        return Pending(harmonics, tables.follow(harmonics.coasting))


@dataclass
class _Frame:
    """Results that the forward pass leaves for the backward pass; the memory belongs to a workspace."""

    grid: Grid
    view: View
    degree: int
    units: int
    pairs: int
    records: Tensor  # [N + 1, 16] the last cannot be seen
    color_slopes: Tensor  # [N, 9]
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
    borders: Tensor  # [count_borders(pairs) * BORDER]
    last_slots: Tensor  # [blocks] int64


def _forward(
    frame_memory: Workspace,
    scratch: Workspace,
    gaussians: Gaussians,
    pending: Pending,
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
    color_slopes = frame_memory.take("color_slopes", count * COLOR_SLOPES.value, torch.float32)
    row_counts = frame_memory.take("row_counts", count, torch.int32)
    keys = scratch.take("depth_keys", count, torch.int32)
    flags = scratch.take("flags", 1, torch.int32).zero_()
    record_ints = records.view(torch.int32)
    parameters = [tensor.detach() for tensor in gaussians.tensors().values()]
    launch(project, count + 1, 128)(
        *parameters,
        *pending.tensors(parameters[-1]),
        count,
        view,
        records,
        record_ints,
        color_slopes,
        keys,
        row_counts,
        radii,
        flags,
        DEGREE=degree,
        DEFERRED=pending.harmonics is not None,
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
        color_slopes,
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
        frame_memory.take("borders", count_borders(pairs) * BORDER.value, torch.float32),
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
        frame.borders,
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
    pending: Pending,
    background: Tensor,
    g_image: Tensor,
    g_alpha: Tensor | None,
    absolute: Tensor | None,
    want_splitting: bool,
) -> tuple[list[Tensor | None], Tensor, Tensor | None]:
    """The gradients of the six tensors, of ``screen_points`` and of the splitting probe; fills ``absolute`` [N, 2] if
    it is given.

    With harmonics that are put off the gradient of ``sh_rest`` is None, and its factors go there.
    """
    grid, count = frame.grid, len(gaussians)
    rows = scratch.take("rows", frame.pairs * ROW.value, torch.float32)
    inner = count_borders(frame.pairs)
    launch_grid(decomposite, inner + grid.blocks)(
        frame.order,
        frame.starts,
        grid.blocks,
        inner,
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
    deferred = pending.harmonics is not None
    *gradients, g_sh_rest = (
        torch.zeros_like(tensor[:0] if deferred and name == "sh_rest" else tensor)
        for name, tensor in gaussians.tensors().items()
    )
    factors = means.new_empty(count if deferred else 0, FACTORS.value)
    g_screen = torch.zeros_like(means[:, :2])
    g_splitting = means.new_zeros(count, 3, 3) if want_splitting else None
    launch(backproject, count, 128)(
        means,
        log_scales,
        quaternions,
        logits,
        frame.row_counts if pending.harmonics is None else pending.harmonics.last,
        count,
        frame.view,
        frame.records.view(torch.int32),
        frame.color_slopes,
        frame.row_counts,
        frame.first_units,
        frame.pair_ends,
        frame.unit_widths,
        rows,
        *gradients,
        g_sh_rest,
        g_screen,
        g_screen if absolute is None else absolute,
        g_screen if g_splitting is None else g_splitting,
        factors,
        factors.view(torch.int32),
        DEGREE=frame.degree,
        DEFERRED=deferred,
        ABSOLUTE=absolute is not None,
        SPLITTING=want_splitting,
    )
    if pending.harmonics is None or pending.tables is None:
        return [*gradients, g_sh_rest], g_screen, g_splitting
    if frame.degree > 0:
        pending.harmonics.receive(Factors(pending.tables, factors, frame.degree))
    return [*gradients, None], g_screen, g_splitting


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
    """State that a render keeps for the backward pass and for its footprint, and the hold on the memory of it."""

    frame: _Frame
    holder: _Holder


class _Render(torch.autograd.Function):
    """The bridge between the kernels and autograd. Nothing that it keeps refers back to it."""

    @staticmethod
    def forward(
        ctx: Any,
        rasterizer: TritonRasterizer,
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
        background, device = background.contiguous(), background.device
        kept.holder, scratch_holder = _Holder(), _Holder()
        image = torch.empty(camera.height, camera.width, 3, dtype=torch.float32, device=device)
        alpha = torch.empty(camera.height, camera.width, dtype=torch.float32, device=device)
        radii = torch.empty(len(gaussians), dtype=torch.int32, device=device)
        with torch.cuda.device_of(background):
            memory = rasterizer._frames.lease(kept.holder, device)
            scratch = rasterizer._scratch.lease(scratch_holder, device)
            pending = rasterizer._pending(harmonics)
            kept.frame = _forward(memory, scratch, gaussians, pending, camera, degree, background, image, alpha, radii)
        ctx.rasterizer, ctx.kept, ctx.pending, ctx.absolute = rasterizer, kept, pending, absolute
        opacity = alpha if ctx.needs_input_grad[6] else None
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
            gradients, g_screen, g_splitting = _backward(
                scratch,
                ctx.kept.frame,
                Gaussians(*tensors),
                ctx.pending,
                background,
                g_image,
                g_alpha,
                ctx.absolute,
                ctx.needs_input_grad[8],
            )
        g_background = None if alpha is None else (g_image * (1 - alpha).unsqueeze(-1)).sum((0, 1))
        return None, None, None, None, None, None, g_background, g_screen, g_splitting, *gradients
