"""Footprints, the pixels that each Gaussian was blended into, from the forward pass's output; run on request.

Sums are made in a fixed order and without atomics, as those of the gradients are.
"""

from __future__ import annotations

import triton
import triton.language as tl

from gsbench.raster.triton.composite import block_pixels, block_places, load_record, log2_alpha
from gsbench.raster.triton.layout import BLOCK_PIXELS, LANE_COLUMNS, LOG2_ALPHA_MIN, ROW, STEPS

COVERED, VALUES, DISTANCES = tl.constexpr(0), tl.constexpr(1), tl.constexpr(2)  # of a row


@triton.jit(do_not_specialize=["width", "height", "blocks_x"])
def cover(
    starts,
    entries,
    slots,
    records,
    width,
    height,
    blocks_x,
    last,
    past,
    values,
    rows_out,
    HAS_VALUES: tl.constexpr,
):
    """Write to the rows of ``rows_out`` [pairs, 16] of one block, for its entries up to ``past`` [blocks]: how many
    pixels each Gaussian was blended into, and the sums over them of ``values`` [H, W], read if ``HAS_VALUES``, and of
    the distances to its mean, px."""
    block = tl.program_id(0)
    inside, pixel, x, y = block_pixels(block, blocks_x, width, height)
    seen = tl.load(last + block * BLOCK_PIXELS + block_places())
    asked = tl.load(values + pixel, mask=inside & HAS_VALUES, other=0.0)
    columns = x[None, :] + (tl.arange(0, STEPS) * LANE_COLUMNS).to(tl.float32)[:, None]
    for position in range(tl.load(starts + block), tl.load(past + block)):
        record = load_record(records, tl.load(entries + position))
        power, _, dy = log2_alpha(record, x, y)
        blended = (power >= LOG2_ALPHA_MIN) & (position < seen)
        dx = columns - record[0]
        distance = tl.sqrt(tl.fma(dx, dx, (dy * dy)[None, :]))
        row = rows_out + tl.load(slots + position) * ROW
        tl.store(row + COVERED, tl.sum(tl.sum(tl.where(blended, 1.0, 0.0), 0), 0))
        tl.store(row + VALUES, tl.sum(tl.sum(tl.where(blended, asked, 0.0), 0), 0))
        tl.store(row + DISTANCES, tl.sum(tl.sum(tl.where(blended, distance, 0.0), 0), 0))


@triton.jit(do_not_specialize=["count"])
def sum_cover(
    count,
    row_counts,
    first_units,
    pair_ends,
    unit_widths,
    rows,
    covered,
    sums,
    distances,
    GROUP: tl.constexpr,
):
    """Write ``covered`` [N] int32, ``sums`` and ``distances`` [N] from the rows that ``sum_units`` has summed."""
    index = tl.program_id(0).to(tl.int64) * GROUP + tl.arange(0, GROUP)  # [GROUP]
    own_rows = tl.load(row_counts + index, mask=index < count, other=0)
    unit = tl.load(first_units + index, mask=own_rows > 0, other=0)
    total = tl.zeros([GROUP], tl.float32)
    value, distance = total, total
    for k in range(0, tl.max(own_rows, 0)):
        active = k < own_rows
        width = tl.load(unit_widths + unit + k, mask=active, other=0)
        place = rows + (tl.load(pair_ends + unit + k, mask=active, other=0) - width) * ROW
        active = width > 0
        total += tl.load(place + COVERED, mask=active, other=0.0)
        value += tl.load(place + VALUES, mask=active, other=0.0)
        distance += tl.load(place + DISTANCES, mask=active, other=0.0)
    tl.store(covered + index, total.to(tl.int32), mask=index < count)
    tl.store(sums + index, value, mask=index < count)
    tl.store(distances + index, distance, mask=index < count)
