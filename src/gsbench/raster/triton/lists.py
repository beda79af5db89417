"""Lists of the Gaussians that each block blends, from what is projected: sorted by depth, then by block."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.gaussians.model import Gaussians
from gsbench.raster.readback import Readback
from gsbench.raster.triton.binning import find_units, summarise, write_pairs
from gsbench.raster.triton.launch import launch, launch_grid
from gsbench.raster.triton.layout import Grid
from gsbench.raster.triton.memory import UNITS_AT_FIRST
from gsbench.raster.triton.workspace import Workspace
from gsbench.raster.validate import raise_for_values

MAX_INT16, MAX_INT32 = 2**15 - 1, 2**31 - 1


class Projected(NamedTuple):
    """Numbers of each Gaussian in a view."""

    records: Tensor  # [N + 1, 16] the last cannot be seen
    color_slopes: Tensor  # [N, 9]
    row_counts: Tensor  # [N] int32 units of each Gaussian


class Units(NamedTuple):
    """Rows of blocks that Gaussians cover, a unit each, those of one Gaussian side by side."""

    number: int
    pairs: int  # of a Gaussian and a block, in all units
    first: Tensor  # [N] int64 of each Gaussian
    widths: Tensor  # [units] int32 pairs of each
    blocks: Tensor  # [units] int32 the first block of each
    pair_ends: Tensor  # [units] int64 running sum of the widths


class Lists(NamedTuple):
    """Gaussians that each block blends."""

    order: Tensor  # [blocks] int64 the longest lists first
    starts: Tensor  # [blocks + 1] int32
    entries: Tensor  # [pairs] int32 Gaussians, by block, front to back
    slots: Tensor  # [pairs] int64 of each entry


def find_all_units(
    memory: Workspace,
    scratch: Workspace,
    gaussians: Gaussians,
    projected: Projected,
    grid: Grid,
    keys: Tensor,
    flags: Tensor,
    background: Tensor,
) -> tuple[Units, Tensor]:
    """List the units of all Gaussians, front to back, and their Gaussians [units]; again where the room was too small.

    Here the host waits for the device.
    """
    count = len(gaussians)
    depth_order = scratch.take("depth_order", count, torch.int64)
    torch.sort(keys, stable=True, out=(scratch.take("sorted_depths", count, torch.int32), depth_order))
    unit_ends = scratch.take("unit_ends", count, torch.int64)
    torch.cumsum(projected.row_counts[depth_order], 0, out=unit_ends)
    first = memory.take("first_units", count, torch.int64)
    status = scratch.take("status", 3, torch.int64)
    capacity = max(memory.capacity("unit_widths"), UNITS_AT_FIRST * count, 1)
    while True:
        owners = scratch.take("unit_owners", capacity, torch.int32)
        blocks = memory.take("unit_blocks", capacity, torch.int32)
        widths = memory.take("unit_widths", capacity, torch.int32).zero_()
        pair_ends = memory.take("pair_ends", capacity, torch.int64)
        launch(find_units, count, 128)(
            depth_order,
            count,
            projected.row_counts,
            unit_ends,
            projected.records,
            projected.records.view(torch.int32),
            grid.blocks_x,
            capacity,
            first,
            owners,
            blocks,
            widths,
        )
        torch.cumsum(widths, 0, out=pair_ends)
        launch_grid(summarise, 1)(unit_ends, count, pair_ends, capacity, flags, background, status)
        units, pairs, bad = Readback(status).values().tolist()  # the one wait for the device
        if bad:
            raise_for_values(gaussians, background)
        if units <= capacity:
            break
        capacity = 2 * units
    if pairs > MAX_INT32:
        raise ValueError(f"gaussians: {pairs} (Gaussian, block) pairs in one view are more than {MAX_INT32}")
    return Units(units, pairs, first, widths, blocks, pair_ends), owners


def make_lists(memory: Workspace, scratch: Workspace, units: Units, owners: Tensor, blocks: int) -> Lists:
    """Sort the pairs of all units by block; within a block they stay front to back."""
    pairs = units.pairs
    key_type = torch.int16 if blocks <= MAX_INT16 else torch.int32
    block_keys = scratch.take(f"block_keys_{key_type}", pairs, key_type)
    sorted_keys = scratch.take(f"sorted_keys_{key_type}", pairs, key_type)
    slot_owners = scratch.take("slot_owners", pairs, torch.int32)
    launch(write_pairs, units.number, 128)(
        owners, units.blocks, units.widths, units.pair_ends, units.number, block_keys, slot_owners
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
    return Lists(order, starts, entries, slots)
