"""Compositing of blocks, forward and backward: a program of one warp a block, four pixels a lane.

The four pixels of a lane lie in one row, so what depends on dy alone is computed once for them.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from gsbench.raster.base import CONSTANTS
from gsbench.raster.triton.layout import (
    BLOCK_HEIGHT,
    BLOCK_PIXELS,
    BLOCK_WIDTH,
    BLUE,
    CURVE_T,
    CURVE_Y,
    GREEN,
    LANE_COLUMNS,
    LANES,
    LOG2_ALPHA_MIN,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    RECORD,
    RED,
    ROW,
    SHEAR,
    STEPS,
    SUM_ABS_T,
    SUM_ABS_Y,
    SUM_BLUE,
    SUM_GREEN,
    SUM_H,
    SUM_H_T,
    SUM_H_TT,
    SUM_H_TY,
    SUM_H_Y,
    SUM_H_YY,
    SUM_RED,
)

ALPHA_MAX = tl.constexpr(CONSTANTS.alpha_max)
TRANSMITTANCE_MIN = tl.constexpr(CONSTANTS.transmittance_min)
CHUNK = tl.constexpr(8)  # list entries between two looks at whether all pixels have stopped
TO_PRECISION = tl.constexpr(2 * math.log(2.0))  # -curve to entry of the inverse covariance, up to sign


@triton.jit
def _pixels(block, blocks_x):
    """The pixels of a block: the first column and row, and within it the columns [STEPS, LANES] and rows [LANES]."""
    lane, step = tl.arange(0, LANES), tl.arange(0, STEPS)
    columns = (lane % LANE_COLUMNS)[None, :] + step[:, None] * LANE_COLUMNS
    return block % blocks_x * BLOCK_WIDTH, block // blocks_x * BLOCK_HEIGHT, columns, lane // LANE_COLUMNS


@triton.jit
def _places():
    """Where the pixels of a block stand in its memory, [STEPS, LANES]."""
    return tl.arange(0, STEPS)[:, None] * LANES + tl.arange(0, LANES)[None, :]


@triton.jit
def _record(records, entry):
    place = records + entry.to(tl.int64) * RECORD
    return (
        tl.load(place + MEAN_X),
        tl.load(place + MEAN_Y),
        tl.load(place + SHEAR),
        tl.load(place + CURVE_T),
        tl.load(place + CURVE_Y),
        tl.load(place + LOG2_OPACITY),
        tl.load(place + RED),
        tl.load(place + GREEN),
        tl.load(place + BLUE),
    )


@triton.jit
def _log2_alpha(record, left, columns, y):
    """log2(alpha) [STEPS, LANES] before it is clamped, t [STEPS, LANES] and dy [LANES].

    Columns count from ``left``, so that no digits are lost far from pixel 0. Every rounding is spelled out: the forward
    and the backward kernel have to agree on each pixel that is skipped.
    """
    mean_x, mean_y, shear, curve_t, curve_y, log2_opacity, _, _, _ = record
    dy = y - mean_y
    t = columns + tl.fma(dy, shear, left - mean_x)[None, :]
    power = tl.fma(curve_t * t, t, tl.fma(curve_y * dy, dy, log2_opacity)[None, :])
    return power, t, dy


@triton.jit
def composite(
    order,
    starts,
    entries,
    records,
    background,
    width,
    height,
    blocks_x,
    image,
    alpha,
    transmittance,
    last,
    past,
):
    """Blend the block that ``order`` [blocks] has at the place of this program.

    In: ``starts`` [blocks + 1], ``entries`` [pairs] the Gaussians of the lists, ``records`` [N, 16]. Out: ``image``
    [H, W, 3], ``alpha`` [H, W]; for the backward pass, by block, step and lane, the final ``transmittance`` and
    ``last``, past the last entry that was looked at before the pixel stopped; ``past`` [blocks], their maximum.
    """
    block = tl.load(order + tl.program_id(0)).to(tl.int32)
    left, top, columns, rows = _pixels(block, blocks_x)
    begin, end = tl.load(starts + block), tl.load(starts + block + 1)
    inside = (left + columns < width) & (top + rows < height)[None, :]
    first_x, x, y = left.to(tl.float32), columns.to(tl.float32), (top + rows).to(tl.float32)
    # A pixel that has stopped, or lies outside, has its transmittance with a minus sign: it stays as it is.
    light = tl.where(inside, 1.0, -1.0)
    red, green, blue = tl.zeros_like(light), tl.zeros_like(light), tl.zeros_like(light)
    seen = tl.where(inside, begin, 0)

    # The records are loaded one entry ahead, the entries two.
    ahead = _record(records, tl.load(entries + begin, mask=begin < end, other=0))
    entry = tl.load(entries + begin + 1, mask=begin + 1 < end, other=0)
    alive = True
    position = begin
    while (position < end) & alive:
        stop = tl.minimum(position + CHUNK, end)
        for k in range(position, stop):
            record = ahead
            ahead = _record(records, entry)
            entry = tl.load(entries + k + 2, mask=k + 2 < end, other=0)
            power, _, _ = _log2_alpha(record, first_x, x, y)
            opacity = tl.where(power >= LOG2_ALPHA_MIN, tl.minimum(tl.exp2(power), ALPHA_MAX), 0.0)
            weight = light * opacity
            after = light - weight
            stopped = after < TRANSMITTANCE_MIN
            weight = tl.where(stopped, 0.0, weight)
            light = tl.where(stopped, -tl.abs(light), after)
            seen = tl.where(stopped, seen, k + 1)
            red = tl.fma(weight, record[6], red)
            green = tl.fma(weight, record[7], green)
            blue = tl.fma(weight, record[8], blue)
        position = stop
        alive = tl.max(tl.max((light > 0).to(tl.int32), 0), 0) > 0

    light = tl.abs(light)
    state = block * BLOCK_PIXELS + _places()
    tl.store(transmittance + state, light)
    tl.store(last + state, seen)
    tl.store(past + block, tl.max(tl.max(seen, 0), 0))
    pixel = (top + rows)[None, :] * width + left + columns
    tl.store(alpha + pixel, 1.0 - light, mask=inside)
    tl.store(image + 3 * pixel, tl.fma(light, tl.load(background), red), mask=inside)
    tl.store(image + 3 * pixel + 1, tl.fma(light, tl.load(background + 1), green), mask=inside)
    tl.store(image + 3 * pixel + 2, tl.fma(light, tl.load(background + 2), blue), mask=inside)


@triton.jit
def _total(values):
    """The sum over a block's pixels: first within each lane."""
    return tl.sum(tl.sum(values, 0), 0)


@triton.jit
def decomposite(
    order,
    starts,
    entries,
    slots,
    records,
    background,
    width,
    height,
    blocks_x,
    transmittance,
    last,
    past,
    g_image,
    g_alpha,
    rows_out,
    HAS_ALPHA: tl.constexpr,
    ABSOLUTE: tl.constexpr,
):
    """Write the gradient sums of one block's pairs to their rows of ``rows_out`` [pairs, 16], back to front.

    Behind a Gaussian lies light S = sum of later (c . g) alpha T plus what the background gets; the loss changes with
    its alpha by T (c . g) - S / (1 - alpha). Going back to front S grows from the background's part, so that nothing
    cancels. ``slots`` [pairs] has the row of each entry. ``g_alpha`` is read if ``HAS_ALPHA``.
    """
    block = tl.load(order + tl.program_id(0)).to(tl.int32)
    left, top, columns, rows = _pixels(block, blocks_x)
    begin, end, stop = tl.load(starts + block), tl.load(starts + block + 1), tl.load(past + block)
    number = tl.arange(0, ROW)

    # Entries that no pixel came to.
    stop = tl.maximum(stop, begin)
    for first in range(stop, end, LANES):
        position = first + tl.arange(0, LANES)
        slot = tl.load(slots + position, mask=position < end, other=0)
        place = rows_out + slot[:, None] * ROW + number[None, :]
        tl.store(place, tl.zeros([LANES, ROW], tl.float32), mask=(position < end)[:, None])

    inside = (left + columns < width) & (top + rows < height)[None, :]
    first_x, x, y = left.to(tl.float32), columns.to(tl.float32), (top + rows).to(tl.float32)
    pixel = (top + rows)[None, :] * width + left + columns
    g_red = tl.load(g_image + 3 * pixel, mask=inside, other=0.0)
    g_green = tl.load(g_image + 3 * pixel + 1, mask=inside, other=0.0)
    g_blue = tl.load(g_image + 3 * pixel + 2, mask=inside, other=0.0)
    state = block * BLOCK_PIXELS + _places()
    light = tl.load(transmittance + state)
    seen = tl.load(last + state)
    behind = g_red * tl.load(background) + g_green * tl.load(background + 1) + g_blue * tl.load(background + 2)
    if HAS_ALPHA:
        behind -= tl.load(g_alpha + pixel, mask=inside, other=0.0)
    behind *= light

    ahead = _record(records, tl.load(entries + stop - 1, mask=begin < stop, other=0))
    entry = tl.load(entries + stop - 2, mask=begin + 1 < stop, other=0)
    for back in range(0, stop - begin):
        k = stop - 1 - back
        record = ahead
        ahead = _record(records, entry)
        entry = tl.load(entries + k - 2, mask=k - 2 >= begin, other=0)
        slot = tl.load(slots + k)
        power, t, dy = _log2_alpha(record, first_x, x, y)
        raw = tl.where((power >= LOG2_ALPHA_MIN) & (k < seen), tl.exp2(power), 0.0)
        opacity = tl.minimum(raw, ALPHA_MAX)
        root = tl.rsqrt(1.0 - opacity)
        inverse = root * root  # cheaper than a division
        shine = tl.fma(g_red, record[6], tl.fma(g_green, record[7], g_blue * record[8]))
        h = raw * inverse * tl.fma(light, shine, -behind)
        light *= inverse
        weight = light * opacity
        behind = tl.fma(weight, shine, behind)

        ht = h * t
        # Within a lane dy is the same for all pixels.
        sum_h, sum_ht, sum_htt = tl.sum(h, 0), tl.sum(ht, 0), tl.sum(ht * t, 0)  # [LANES]
        sum_hy = sum_h * dy
        row = tl.where(number == SUM_H, tl.sum(sum_h, 0), 0.0)
        row = tl.where(number == SUM_H_T, tl.sum(sum_ht, 0), row)
        row = tl.where(number == SUM_H_Y, tl.sum(sum_hy, 0), row)
        row = tl.where(number == SUM_H_TT, tl.sum(sum_htt, 0), row)
        row = tl.where(number == SUM_H_TY, tl.sum(sum_ht * dy, 0), row)
        row = tl.where(number == SUM_H_YY, tl.sum(sum_hy * dy, 0), row)
        row = tl.where(number == SUM_RED, _total(weight * g_red), row)
        row = tl.where(number == SUM_GREEN, _total(weight * g_green), row)
        row = tl.where(number == SUM_BLUE, _total(weight * g_blue), row)
        if ABSOLUTE:
            # d power / d mean_y = shear a t + e dy, with a and e from the curves: curve = -log2(e)/2 a
            slope = tl.fma(record[2] * record[3], ht, record[4] * (h * dy[None, :]))
            row = tl.where(number == SUM_ABS_T, _total(tl.abs(ht)), row)
            row = tl.where(number == SUM_ABS_Y, _total(tl.abs(slope)) * TO_PRECISION, row)
        tl.store(rows_out + slot * ROW + number, row)
