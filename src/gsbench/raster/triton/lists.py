"""Lists of the Gaussians that each block composites, front to back.

In each row of blocks, the contour alpha = 1/255 of a Gaussian covers a span of blocks. One
(Gaussian, row) is a *unit*, one (Gaussian, block) a *pair*. Units and pairs are numbered by depth
of the Gaussian, then by row and column; the number of a pair is its *slot*. A stable sort of the
pairs by block gives the list of each block.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsbench.raster.base import CONSTANTS
from gsbench.raster.staged import RenderRequest
from gsbench.raster.triton.launch import Allocate, Workspace, launch, launch_grid
from gsbench.raster.triton.layout import (
    BLOCK_HEIGHT,
    BLOCK_WIDTH,
    COLUMNS,
    CURVE_T,
    CURVE_Y,
    FIRST_ROW,
    LOG2_ALPHA_MIN,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    RECORD,
    RIGHTMOST_Y,
    SHEAR,
)

# Margins for float32 rounding: it must not lose a pixel of the contour.
REACH_MARGIN = tl.constexpr(CONSTANTS.log2_alpha_margin)
PIXEL_MARGIN = tl.constexpr(CONSTANTS.pixel_margin)
FLOAT_MARGIN = tl.constexpr(1e-6)  # of a coordinate: several roundings of float32
MAX_COLUMN = tl.constexpr(1e6)  # px; beyond every image, but within int32


@triton.jit
def _span(records, place, row, first, past, mask):
    """The first and the past-the-last block column that the contour reaches in ``row``.

    Both are within ``first`` to ``past``.
    """
    mean_x = tl.load(records + place + MEAN_X, mask=mask, other=0.0)
    mean_y = tl.load(records + place + MEAN_Y, mask=mask, other=0.0)
    shear = tl.load(records + place + SHEAR, mask=mask, other=0.0)
    curve_t = tl.load(records + place + CURVE_T, mask=mask, other=-1.0)
    curve_y = tl.load(records + place + CURVE_Y, mask=mask, other=-1.0)
    log2_opacity = tl.load(records + place + LOG2_OPACITY, mask=mask, other=0.0)
    rightmost = tl.load(records + place + RIGHTMOST_Y, mask=mask, other=0.0)
    reach = log2_opacity - LOG2_ALPHA_MIN + REACH_MARGIN
    margin_y = PIXEL_MARGIN + FLOAT_MARGIN * tl.abs(mean_y)
    top = (row * BLOCK_HEIGHT).to(tl.float32) - mean_y - margin_y
    bottom = top + (BLOCK_HEIGHT - 1) + 2 * margin_y
    # As a function of y, the contour's right side is concave and its left side convex. So the
    # extremes within the row are at the rightmost and the leftmost point, clamped to the row.
    y_right = tl.minimum(tl.maximum(rightmost, top), bottom)
    y_left = tl.minimum(tl.maximum(-rightmost, top), bottom)
    right = (
        tl.sqrt(tl.maximum((reach + curve_y * y_right * y_right) / -curve_t, 0.0)) - shear * y_right
    )
    left = (
        -tl.sqrt(tl.maximum((reach + curve_y * y_left * y_left) / -curve_t, 0.0)) - shear * y_left
    )
    margin_x = PIXEL_MARGIN + FLOAT_MARGIN * (
        tl.abs(mean_x) + tl.maximum(tl.abs(left), tl.abs(right))
    )
    low = tl.ceil(tl.minimum(tl.maximum(mean_x + left - margin_x, -MAX_COLUMN), MAX_COLUMN)).to(
        tl.int32
    )
    high = tl.floor(tl.minimum(tl.maximum(mean_x + right + margin_x, -MAX_COLUMN), MAX_COLUMN)).to(
        tl.int32
    )
    # Triton's // truncates towards 0, which would be wrong below 0: hence the maximum.
    low, high = tl.maximum(low, 0) // BLOCK_WIDTH, tl.maximum(high + BLOCK_WIDTH, 0) // BLOCK_WIDTH
    return tl.maximum(low, first), tl.minimum(high, past)


@triton.jit(do_not_specialize=["count", "blocks_x", "capacity"])
def find_units(
    order,
    count,
    unit_ends,
    projected,
    record_ints,
    blocks_x,
    capacity,
    found,
    GROUP: tl.constexpr,
):
    """Find the units of all Gaussians, in the ``order`` [N] of depth; one lane per Gaussian.

    In: ``unit_ends`` [N], the running sum of the row counts in that order. Out, in ``found``
    (`Units`): the first unit of each Gaussian; and for each unit its Gaussian, its first block and
    its number of blocks, which may be 0. Units from ``capacity`` on are not written.
    """
    rank = tl.program_id(0).to(tl.int64) * GROUP + tl.arange(0, GROUP)  # [GROUP]
    inside = rank < count
    index = tl.load(order + rank, mask=inside, other=0)
    rows = tl.load(projected.row_counts + index, mask=inside, other=0)
    unit = tl.load(unit_ends + rank, mask=inside, other=0) - rows
    tl.store(found.first + index, unit, mask=inside)
    place = index * RECORD
    columns = tl.load(record_ints + place + COLUMNS, mask=rows > 0, other=0)
    first_row = tl.load(record_ints + place + FIRST_ROW, mask=rows > 0, other=0)
    first, past = columns & 0xFFFF, columns >> 16
    for k in range(0, tl.max(rows, 0)):
        active = (k < rows) & (unit + k < capacity)
        low, high = _span(projected.records, place, first_row + k, first, past, active)
        tl.store(found.owners + unit + k, index.to(tl.int32), mask=active)
        tl.store(found.blocks + unit + k, (first_row + k) * blocks_x + low, mask=active)
        tl.store(found.widths + unit + k, tl.maximum(high - low, 0), mask=active)


@triton.jit(do_not_specialize=["count", "capacity"])
def summarise(unit_ends, count, capacity, flags, background, found):
    """Fill the status of ``found`` (`Units`): numbers of units and pairs, 1 if a value is bad.

    The number of pairs is correct only if there are at most ``capacity`` units.
    """
    units = tl.load(unit_ends + count - 1, mask=count > 0, other=0)
    pairs = tl.load(found.pair_ends + capacity - 1)
    channel = tl.arange(0, 4)
    light = tl.load(background + channel, mask=channel < 3, other=0.0)
    bad = tl.load(flags) | tl.max((~(tl.abs(light) < float("inf"))).to(tl.int32), 0)
    tl.store(found.status, units)
    tl.store(found.status + 1, pairs)
    tl.store(found.status + 2, bad.to(tl.int64))


@triton.jit
def lists_fit(status, units, pairs):
    """True if ``status`` has at most as many units and pairs as these capacities.

    If not, all kernels behind behave as if no Gaussian were seen, so they stay within their memory.
    The host looks at ``status``, makes room, and repeats the render.
    """
    return (tl.load(status) <= units) & (tl.load(status + 1) <= pairs)


@triton.jit
def units_that_fit(status, units, pairs):
    """The number of units in ``status``; 0 if the lists do not fit (`lists_fit`)."""
    return tl.where(lists_fit(status, units, pairs), tl.load(status), 0)


@triton.jit(do_not_specialize=["units", "pairs"])
def write_pairs(found, units, pairs, keys, owners, GROUP: tl.constexpr):
    """Write the block (``keys``) and the Gaussian (``owners``) of each slot, both [pairs].

    Each lane handles one unit of ``found`` (`Units`). See `units_that_fit`.
    """
    unit = tl.program_id(0).to(tl.int64) * GROUP + tl.arange(0, GROUP)  # [GROUP]
    inside = unit < units_that_fit(found.status, units, pairs)
    width = tl.load(found.widths + unit, mask=inside, other=0)
    slot = tl.load(found.pair_ends + unit, mask=inside, other=0) - width
    block = tl.load(found.blocks + unit, mask=inside, other=0)
    owner = tl.load(found.owners + unit, mask=inside, other=0)
    for k in range(0, tl.max(width, 0)):
        tl.store(keys + slot + k, (block + k).to(keys.dtype.element_ty), mask=k < width)
        tl.store(owners + slot + k, owner, mask=k < width)


MAX_INT16, MAX_INT32 = 2**15 - 1, 2**31 - 1
UNITS_AT_FIRST = 2  # units per Gaussian that the first attempt has room for


class Room(NamedTuple):
    """The numbers of units and pairs that there is memory for."""

    units: int
    pairs: int


class Parameters(NamedTuple):
    """The tensors of Gaussians, or their gradients; see `gsbench.gaussians.model.Gaussians`."""

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    opacity_logits: Tensor
    sh_dc: Tensor
    sh_rest: Tensor


class Projected(NamedTuple):
    """Results of projection for each of N Gaussians."""

    records: Tensor  # [N + 1, 16] the last one is invisible
    color_slopes: Tensor  # [N, 9]
    row_counts: Tensor  # [N] int32 number of units of each Gaussian


class Units(NamedTuple):
    """The units of all Gaussians; those of one Gaussian are adjacent. R is the room for them."""

    first: Tensor  # [N] int64 first unit of each Gaussian
    widths: Tensor  # [R] int32 number of pairs of each unit
    blocks: Tensor  # [R] int32 first block of each unit
    pair_ends: Tensor  # [R] int64 running sum of the widths
    owners: Tensor  # [R] int32 Gaussian of each unit; scratch memory
    status: Tensor  # [3] int64, see `summarise`


class Lists(NamedTuple):
    """The lists of Gaussians that blocks composite. P is the room for pairs."""

    room: Room
    order: Tensor  # [blocks] int64 blocks, longest lists first
    starts: Tensor  # [blocks + 1] int32 first entry of each block
    entries: Tensor  # [P] int32 Gaussians, by block, front to back
    slots: Tensor  # [P] int64 slot of each entry


class Blocks(NamedTuple):
    """Inputs of all kernels that go through the lists of blocks."""

    starts: Tensor  # [blocks + 1] int32
    entries: Tensor  # [P] int32
    records: Tensor  # [N + 1, 16]
    last: Tensor  # [blocks * BLOCK_PIXELS] int32, end of the entries read before a pixel stopped


class Pixels(NamedTuple):
    """Memory of both passes of compositing, besides `Blocks`."""

    order: Tensor  # [blocks] int64
    background: Tensor  # [3]
    transmittance: Tensor  # [blocks * BLOCK_PIXELS] the final one, by block, lane and step
    borders: Tensor  # [count_borders(P) * BORDER] those that compositing of the pixel crossed


def sort_by_depth(scratch: Workspace, projected: Projected, keys: Tensor) -> tuple[Tensor, Tensor]:
    """Return the order of the Gaussians by ``keys``, and the running sum of their units in it."""
    count = len(keys)
    order = scratch.take("depth_order", count, torch.int64)
    torch.sort(keys, stable=True, out=(scratch.take("sorted_depths", count, torch.int32), order))
    unit_ends = scratch.take("unit_ends", count, torch.int64)
    torch.cumsum(projected.row_counts[order], 0, out=unit_ends)
    return order, unit_ends


@dataclass
class Started:
    """A render up to its units. The host does not know yet how many there are."""

    request: RenderRequest
    view: Tensor  # [24] float32, the numbers of the camera
    memory: Workspace  # of what the backward pass needs
    scratch: Workspace
    allocate: Allocate
    radii: Tensor  # [N] int32
    projected: Projected
    order: Tensor  # [N] int64 Gaussians by depth
    unit_ends: Tensor  # [N] int64
    flags: Tensor  # [1] int32
    units: Units = field(init=False)  # of the last `find_units`

    @property
    def blocks_x(self) -> int:
        return -(-self.request.camera.width // BLOCK_WIDTH.value)

    @property
    def blocks(self) -> int:
        return self.blocks_x * -(-self.request.camera.height // BLOCK_HEIGHT.value)

    def find_units(self, capacity: int) -> None:
        """Find the units of all Gaussians, as many as ``capacity`` admits.

        The host does not wait: the device keeps the real numbers of units and pairs in ``status``.
        """
        memory, count = self.memory, len(self.order)
        self.units = Units(
            memory.take("first_units", count, torch.int64),
            memory.take("unit_widths", capacity, torch.int32).zero_(),
            memory.take("unit_blocks", capacity, torch.int32),
            memory.take("pair_ends", capacity, torch.int64),
            self.scratch.take("unit_owners", capacity, torch.int32),
            memory.take("status", 3, torch.int64),
        )
        launch(find_units, count, 128)(
            order=self.order,
            count=count,
            unit_ends=self.unit_ends,
            projected=self.projected,
            record_ints=self.projected.records.view(torch.int32),
            blocks_x=self.blocks_x,
            capacity=capacity,
            found=self.units,
        )
        torch.cumsum(self.units.widths, 0, out=self.units.pair_ends)
        launch_grid(summarise, 1)(
            unit_ends=self.unit_ends,
            count=count,
            capacity=capacity,
            flags=self.flags,
            background=self.request.background,
            found=self.units,
        )


def check_pairs(pairs: int) -> None:
    """Raise ValueError if there are too many ``pairs`` to sort."""
    if pairs > MAX_INT32:
        raise ValueError(
            f"gaussians: {pairs} (Gaussian, block) pairs in one view are more than {MAX_INT32}"
        )


def make_lists(started: Started, room: Room) -> Lists:
    """Sort the pairs of all units by block; within a block they stay front to back.

    Pairs that ``room`` has more than there are sort behind the last block.
    """
    memory, scratch, blocks, pairs = started.memory, started.scratch, started.blocks, room.pairs
    key_type = torch.int16 if blocks <= MAX_INT16 else torch.int32
    block_keys = scratch.take(f"block_keys_{key_type}", pairs, key_type).fill_(blocks)
    sorted_keys = scratch.take(f"sorted_keys_{key_type}", pairs, key_type)
    slot_owners = scratch.take("slot_owners", pairs, torch.int32)
    launch(write_pairs, room.units, 128)(
        found=started.units, **room._asdict(), keys=block_keys, owners=slot_owners
    )
    slots = memory.take("slots", pairs, torch.int64)
    torch.sort(block_keys, stable=True, out=(sorted_keys, slots))
    entries = memory.take("entries", pairs, torch.int32)
    torch.index_select(slot_owners, 0, slots, out=entries)
    starts = memory.take("starts", blocks + 1, torch.int32)
    numbers = torch.arange(blocks + 1, dtype=key_type, device=slots.device)
    torch.searchsorted(sorted_keys, numbers, out_int32=True, out=starts)
    order = memory.take("order", blocks, torch.int64)
    lengths = scratch.take("sorted_lengths", blocks, torch.int32)
    torch.sort(starts[1:] - starts[:-1], descending=True, stable=True, out=(lengths, order))
    return Lists(room, order, starts, entries, slots)
