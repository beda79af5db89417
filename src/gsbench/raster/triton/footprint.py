"""Footprints: what each Gaussian was blended into."""

from __future__ import annotations

import triton
import triton.language as tl

from gsbench.raster.triton.composite import (
    block_pixels,
    block_places,
    load_record,
    log2_alpha,
    store_last_slot,
)
from gsbench.raster.triton.layout import (
    BLOCK_PIXELS,
    LANE_COLUMNS,
    LOG2_ALPHA_MIN,
    ROW,
    STEPS,
)
from gsbench.raster.triton.projection import sum_rows


@triton.jit(do_not_specialize=["width", "height", "blocks_x"])
def cover(
    lists,
    slots,
    width,
    height,
    blocks_x,
    values,
    rows_out,
    last_slots,
    HAS_VALUES: tl.constexpr,
):
    """Write the footprints of the entries of a block that compositing reached to ``rows_out``.

    Each of them has a row of ``rows_out`` [pairs, 16]. A footprint is the number of pixels that the
    Gaussian was blended into, and the sums over them of ``values`` [H, W], read only if
    ``HAS_VALUES``, and of the distances to its mean, px. ``last_slots``: see `store_last_slot`.
    """
    block = tl.program_id(0)
    steps = tl.arange(0, STEPS)
    inside, pixel, x, y = block_pixels(block, steps, blocks_x, width, height)
    seen = tl.load(lists.last + block * BLOCK_PIXELS + block_places(steps))
    begin, end = tl.load(lists.starts + block), tl.max(tl.max(seen, 0), 0)
    store_last_slot(slots, last_slots, block, begin, end, True)
    given = tl.load(values + pixel, mask=inside & HAS_VALUES, other=0.0)
    columns = x[None, :] + (steps * LANE_COLUMNS).to(tl.float32)[:, None]
    for position in range(begin, end):
        record = load_record(lists.records, tl.load(lists.entries + position))
        power, _, dy = log2_alpha(record, steps, x, y)
        blended = (power >= LOG2_ALPHA_MIN) & (position < seen)
        dx = columns - record[0]
        distance = tl.sqrt(tl.fma(dx, dx, (dy * dy)[None, :]))
        row = rows_out + tl.load(slots + position) * ROW
        tl.store(row, tl.sum(tl.sum(tl.where(blended, 1.0, 0.0), 0), 0))
        tl.store(row + 1, tl.sum(tl.sum(tl.where(blended, given, 0.0), 0), 0))
        tl.store(row + 2, tl.sum(tl.sum(tl.where(blended, distance, 0.0), 0), 0))


@triton.jit(do_not_specialize=["count"])
def sum_cover(
    count,
    row_counts,
    found,
    rows,
    covered,
    sums,
    distances,
    GROUP: tl.constexpr,
):
    """Write ``covered`` [N] int32, ``sums`` and ``distances`` [N] from the rows of units."""
    index = tl.program_id(0).to(tl.int64) * GROUP + tl.arange(0, GROUP)  # [GROUP]
    inside = index < count
    own_rows = tl.load(row_counts + index, mask=inside, other=0)
    total, value, distance = sum_rows(index, own_rows, found, rows, 3)
    tl.store(covered + index, total.to(tl.int32), mask=inside)
    tl.store(sums + index, value, mask=inside)
    tl.store(distances + index, distance, mask=inside)
