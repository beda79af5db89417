"""Lists of the Gaussians that each block composites, front to back.

A Gaussian's blocks are found row by row: the contour alpha = 1/255 cuts a span of blocks from each row of blocks. One
(Gaussian, row) is a *unit*, one (Gaussian, block) a *pair*. Units and pairs are numbered front to back and, within a
Gaussian, in order; the number of a pair is its *slot*. Sorting the pairs by block, and else leaving them in
order, gives every block its list.
"""

from __future__ import annotations

import triton
import triton.language as tl

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

# Rounding must not lose a pixel of the contour.
REACH_MARGIN = tl.constexpr(1e-3)  # in log2(alpha)
PIXEL_MARGIN = tl.constexpr(0.02)  # px
FLOAT_MARGIN = tl.constexpr(1e-6)  # of a coordinate, several float32 roundings
MAX_COLUMN = tl.constexpr(1e6)  # px; beyond every image, and inside int32


@triton.jit
def _span(records, place, row, first, past, mask):
    """Columns of blocks, within ``first`` to ``past``, that the contour reaches in ``row``: first, past the last."""
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
    # The contour's x over y is concave on the right and convex on the left: the extremes within the row are at its
    # rightmost and leftmost points, clamped to the row.
    y_right = tl.minimum(tl.maximum(rightmost, top), bottom)
    y_left = tl.minimum(tl.maximum(-rightmost, top), bottom)
    right = tl.sqrt(tl.maximum((reach + curve_y * y_right * y_right) / -curve_t, 0.0)) - shear * y_right
    left = -tl.sqrt(tl.maximum((reach + curve_y * y_left * y_left) / -curve_t, 0.0)) - shear * y_left
    margin_x = PIXEL_MARGIN + FLOAT_MARGIN * (tl.abs(mean_x) + tl.maximum(tl.abs(left), tl.abs(right)))
    low = tl.ceil(tl.minimum(tl.maximum(mean_x + left - margin_x, -MAX_COLUMN), MAX_COLUMN)).to(tl.int32)
    high = tl.floor(tl.minimum(tl.maximum(mean_x + right + margin_x, -MAX_COLUMN), MAX_COLUMN)).to(tl.int32)
    # Below 0 the division truncates upwards, but ``first`` is at least 0.
    low, high = tl.maximum(low, 0) // BLOCK_WIDTH, tl.maximum(high + BLOCK_WIDTH, 0) // BLOCK_WIDTH
    return tl.maximum(low, first), tl.minimum(high, past)


@triton.jit(do_not_specialize=["count", "blocks_x", "capacity"])
def find_units(
    order,
    count,
    row_counts,
    unit_ends,
    records,
    record_ints,
    blocks_x,
    capacity,
    first_units,
    unit_owners,
    unit_blocks,
    unit_widths,
    GROUP: tl.constexpr,
):
    """Fill the units of the Gaussians in the ``order`` [N] of their depth; a lane a Gaussian.

    ``unit_ends`` [N] is the running sum of ``row_counts`` in that order. Out: ``first_units`` [N], the first unit of
    each Gaussian, and for each unit its Gaussian, its first block and its number of blocks (possibly 0), as far as
    ``capacity`` goes.
    """
    rank = tl.program_id(0).to(tl.int64) * GROUP + tl.arange(0, GROUP)  # [GROUP]
    inside = rank < count
    index = tl.load(order + rank, mask=inside, other=0)
    rows = tl.load(row_counts + index, mask=inside, other=0)
    unit = tl.load(unit_ends + rank, mask=inside, other=0) - rows
    tl.store(first_units + index, unit, mask=inside)
    place = index * RECORD
    columns = tl.load(record_ints + place + COLUMNS, mask=rows > 0, other=0)
    first_row = tl.load(record_ints + place + FIRST_ROW, mask=rows > 0, other=0)
    first, past = columns & 0xFFFF, columns >> 16
    for k in range(0, tl.max(rows, 0)):
        active = (k < rows) & (unit + k < capacity)
        low, high = _span(records, place, first_row + k, first, past, active)
        tl.store(unit_owners + unit + k, index.to(tl.int32), mask=active)
        tl.store(unit_blocks + unit + k, (first_row + k) * blocks_x + low, mask=active)
        tl.store(unit_widths + unit + k, tl.maximum(high - low, 0), mask=active)


@triton.jit(do_not_specialize=["count", "capacity"])
def summarise(unit_ends, count, pair_ends, capacity, flags, background, status):
    """``status`` [3] int64: the number of units, of pairs (if the units fit), and whether a value is bad."""
    units = tl.load(unit_ends + count - 1, mask=count > 0, other=0)
    pairs = tl.load(pair_ends + capacity - 1)
    channel = tl.arange(0, 4)
    light = tl.load(background + channel, mask=channel < 3, other=0.0)
    bad = tl.load(flags) | tl.max((~(tl.abs(light) < float("inf"))).to(tl.int32), 0)
    tl.store(status, units)
    tl.store(status + 1, pairs)
    tl.store(status + 2, bad.to(tl.int64))


@triton.jit(do_not_specialize=["units"])
def write_pairs(unit_owners, unit_blocks, unit_widths, pair_ends, units, keys, owners, GROUP: tl.constexpr):
    """Write each slot's block (``keys``) and Gaussian (``owners``), both [pairs]; a lane a unit."""
    unit = tl.program_id(0).to(tl.int64) * GROUP + tl.arange(0, GROUP)  # [GROUP]
    inside = unit < units
    width = tl.load(unit_widths + unit, mask=inside, other=0)
    slot = tl.load(pair_ends + unit, mask=inside, other=0) - width
    block = tl.load(unit_blocks + unit, mask=inside, other=0)
    owner = tl.load(unit_owners + unit, mask=inside, other=0)
    for k in range(0, tl.max(width, 0)):
        tl.store(keys + slot + k, (block + k).to(keys.dtype.element_ty), mask=k < width)
        tl.store(owners + slot + k, owner, mask=k < width)
