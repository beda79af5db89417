"""Compositing of blocks, forward and backward.

The formulas are those of 3DGS (Kerbl et al. 2023, eq. 2 to 4; renderCUDA in its code). With the
density G, the opacity o and the colour c of each Gaussian, front to back,

    alpha = min(0.99, o G),  skipped below 1/255
    image = sum of c alpha T + background T_end,  T = product of (1 - alpha) of those before

and a pixel stops before the Gaussian that would lower T below 1e-4.

One program of one warp composites a block, four pixels per lane. With one warp, nothing is shared
between warps: the loop over a list has no barrier, shuffles pass a record from the lane that loaded
it to all 128 pixels, and compute gradient sums. The four pixels of a lane are in one row, so terms
that depend only on dy are computed once for all four, and four chains of fma run in parallel. If a
list is long, four programs composite it, one pixel per lane; each pixel gets the same bits.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from gsbench.raster.base import CONSTANTS
from gsbench.raster.triton.layout import (
    BEHIND_BLUE,
    BEHIND_GREEN,
    BEHIND_RED,
    BLOCK_HEIGHT,
    BLOCK_PIXELS,
    BLOCK_WIDTH,
    BORDER,
    LANE_COLUMNS,
    LANES,
    LOG2_ALPHA_MIN,
    RECORD,
    ROW,
    SEGMENT,
    STEPS,
    TRANSMITTANCE,
)

ALPHA_MAX = tl.constexpr(CONSTANTS.alpha_max)
TRANSMITTANCE_MIN = tl.constexpr(CONSTANTS.transmittance_min)
UNROLL = tl.constexpr(4)  # entries between two checks whether all pixels have stopped
BATCH = tl.constexpr(min(LANES.value, SEGMENT.value))  # entries that are loaded at once
# A list is long if it has several segments and more than this share of all pairs. A GPU has about
# 500 schedulers, so one program needs a quarter of the whole kernel's time for such a list.
LONG_SHARE = tl.constexpr(2048)
NUMBERS = tl.constexpr(9)  # of a record that compositing loads
UNROLL_BACK = tl.constexpr(2)  # entries per iteration of the backward pass's loop
# -curve to entry of the inverse covariance, up to sign
TO_PRECISION = tl.constexpr(2 * math.log(2.0))


@triton.jit
def block_pixels(block, steps, blocks_x, width, height):
    """The pixels of a block that its lanes have at ``steps`` [S].

    Returns a mask of the pixels in the image and their numbers in it, both [S, LANES]; then for
    each lane the column of its first pixel and the row of all four, both [LANES] px.
    """
    lane = tl.arange(0, LANES)
    x = block % blocks_x * BLOCK_WIDTH + lane % LANE_COLUMNS
    y = block // blocks_x * BLOCK_HEIGHT + lane // LANE_COLUMNS
    columns = x[None, :] + steps[:, None] * LANE_COLUMNS
    inside = (columns < width) & (y < height)[None, :]
    return inside, y[None, :] * width + columns, x.to(tl.float32), y.to(tl.float32)


@triton.jit
def block_places(steps):
    """The places of a block's pixels in memory, [S, LANES]; those of a lane are adjacent.

    With this order Triton chooses a layout of [S, LANES] in which sums over steps stay within a
    lane.
    """
    return steps[:, None] + tl.arange(0, LANES)[None, :] * STEPS


@triton.jit
def load_record(records, entry):
    """The `NUMBERS` of the record ``entry``, in the order of `layout`."""
    place, found = records + entry.to(tl.int64) * RECORD, ()
    # Triton's tuples grow by ``+``; it knows neither ``*`` nor comprehensions.
    for n in tl.static_range(NUMBERS):
        found = found + (tl.load(place + n),)  # type: ignore[assignment]  # noqa: RUF005
    return found


@triton.jit
def _record_of(batch, lane):
    """The record that ``lane`` of a batch has, in all lanes."""
    index, found = tl.zeros([LANES], tl.int32) + lane, ()
    for n in tl.static_range(NUMBERS):
        found = found + (tl.gather(batch[n], index, 0),)  # type: ignore[assignment]  # noqa: RUF005
    return found


@triton.jit
def log2_alpha(record, steps, x, y):
    """log2(alpha) before the clamp and t, both [S, LANES], and dy [LANES].

    x and y are those of ``block_pixels``. The record's numbers are [] or [LANES]. Each fma is
    explicit, so that the forward and the backward kernel round alike and skip the same pixels.
    """
    mean_x, mean_y, shear, curve_t, curve_y, log2_opacity, _, _, _ = record
    dy = y - mean_y
    along = (steps * LANE_COLUMNS).to(tl.float32)
    t = tl.fma(dy, shear, x - mean_x)[None, :] + along[:, None]
    power = tl.fma(curve_t * t, t, tl.fma(curve_y * dy, dy, log2_opacity)[None, :])
    return power, t, dy


@triton.jit
def _leave_light_behind(first_border, crossed, red, green, blue):
    """Replace the light in each of the ``crossed`` borders; return the light of all segments.

    A border has the light of the segment before it, and gets the light of all segments behind it.
    ``red``, ``green`` and ``blue`` are the light of the last segment. Segments are added back to
    front, so no subtraction is needed.
    """
    for k in range(0, crossed):
        place = first_border + (crossed - 1 - k) * BORDER
        before = (
            tl.load(place + BEHIND_RED),
            tl.load(place + BEHIND_GREEN),
            tl.load(place + BEHIND_BLUE),
        )
        tl.store(place + BEHIND_RED, red)
        tl.store(place + BEHIND_GREEN, green)
        tl.store(place + BEHIND_BLUE, blue)
        red, green, blue = red + before[0], green + before[1], blue + before[2]
    return red, green, blue


@triton.jit
def _composite_pixels(block, begin, end, steps, size, lists, pixels, closing, image, alpha):
    """Composite a list, ``begin`` to ``end``, into the pixels of ``block`` at ``steps`` [S].

    See ``composite`` for the other arguments; ``size`` is that of the image.
    """
    width, height, blocks_x = size
    entries, records, background = lists.entries, lists.records, pixels.background
    inside, pixel, x, y = block_pixels(block, steps, blocks_x, width, height)
    # The transmittance of a pixel that has stopped or is outside the image has a minus sign: it
    # does not change again.
    light = tl.where(inside, 1.0, -1.0)
    red, green, blue = tl.zeros_like(light), tl.zeros_like(light), tl.zeros_like(light)
    seen = tl.where(inside, begin, 0)

    # The longest lists end last, when nothing else hides that a record comes from far away. So
    # each lane loads the record of another entry, a whole batch before it is used, and its entry
    # one batch earlier; behind the end of the list, the invisible record is used.
    own = begin + tl.arange(0, LANES)
    ahead = load_record(records, tl.load(entries + own, mask=own < end, other=closing))
    own += BATCH
    found = tl.load(entries + own, mask=own < end, other=closing)
    alive = True
    position = begin
    places = block_places(steps)
    first_border = pixels.borders + (begin // SEGMENT).to(tl.int64) * BORDER + places
    crossed = 0
    while (position < end) & alive:
        border = tl.minimum(position + SEGMENT, end)
        while (position < border) & alive:
            current = ahead
            ahead = load_record(records, found)
            own += BATCH
            found = tl.load(entries + own, mask=own < end, other=closing)
            lane = 0
            while (lane < BATCH) & (position < border) & alive:
                for _ in tl.static_range(UNROLL):
                    record = _record_of(current, lane)
                    lane += 1
                    position += 1
                    power, _, _ = log2_alpha(record, steps, x, y)
                    opacity = tl.where(
                        power >= LOG2_ALPHA_MIN, tl.minimum(tl.exp2(power), ALPHA_MAX), 0.0
                    )
                    weight = light * opacity
                    # Explicit, so that it rounds alike for all numbers of steps. Triton computes
                    # -x as 0 - x, an instruction more.
                    after = tl.fma(-1.0 * light, opacity, light)
                    stopped = after < TRANSMITTANCE_MIN
                    weight = tl.where(stopped, 0.0, weight)
                    light = tl.where(stopped, -tl.abs(light), after)
                    seen = tl.where(stopped, seen, position)
                    red = tl.fma(weight, record[6], red)
                    green = tl.fma(weight, record[7], green)
                    blue = tl.fma(weight, record[8], blue)
                alive = tl.max(tl.max((light > 0).to(tl.int32), 0), 0) > 0
        if (position < end) & alive:
            place = first_border + crossed * BORDER
            tl.store(place + TRANSMITTANCE, tl.abs(light))
            tl.store(place + BEHIND_RED, red)  # for now, the light of the segment before the border
            tl.store(place + BEHIND_GREEN, green)
            tl.store(place + BEHIND_BLUE, blue)
            red, green, blue = tl.zeros_like(light), tl.zeros_like(light), tl.zeros_like(light)
            crossed += 1

    # The lane that loads a number of a border need not be the one that stored it.
    tl.debug_barrier()
    red, green, blue = _leave_light_behind(first_border, crossed, red, green, blue)

    light = tl.abs(light)
    state = block * BLOCK_PIXELS + places
    tl.store(pixels.transmittance + state, light)
    tl.store(lists.last + state, tl.minimum(seen, end))
    tl.store(alpha + pixel, 1.0 - light, mask=inside)
    tl.store(image + 3 * pixel, tl.fma(light, tl.load(background), red), mask=inside)
    tl.store(image + 3 * pixel + 1, tl.fma(light, tl.load(background + 1), green), mask=inside)
    tl.store(image + 3 * pixel + 2, tl.fma(light, tl.load(background + 2), blue), mask=inside)


@triton.jit(do_not_specialize=["split", "closing", "width", "height", "blocks_x"])
def composite(lists, pixels, split, closing, width, height, blocks_x, image, alpha):
    """Composite the blocks in their order; the first programs have those with long lists.

    Each of the first ``split`` blocks has ``STEPS`` programs. If its list is long, each of them
    composites the pixels of one step; if not, the first composites all. The record at ``closing``
    is invisible. ``image`` is [H, W, 3], ``alpha`` [H, W]; ``lists`` are `Blocks`, ``pixels``
    `Pixels`, of which the last entries, transmittances and borders are written.
    """
    program = tl.program_id(0)
    step = program % STEPS
    rank = program // STEPS
    if rank >= split:
        step = 0
        rank = program - split * (STEPS - 1)
    block = tl.load(pixels.order + rank).to(tl.int32)
    begin, end = tl.load(lists.starts + block), tl.load(lists.starts + block + 1)
    pairs = tl.load(lists.starts + tl.num_programs(0) - split * (STEPS - 1))
    size = (width, height, blocks_x)
    if (rank < split) & (end - begin > tl.maximum(pairs // LONG_SHARE, SEGMENT)):
        steps = step + tl.arange(0, 1)
        _composite_pixels(block, begin, end, steps, size, lists, pixels, closing, image, alpha)
    elif step == 0:
        steps_of_all = tl.arange(0, STEPS)
        _composite_pixels(
            block, begin, end, steps_of_all, size, lists, pixels, closing, image, alpha
        )


@triton.jit
def _fold(a, b, lane, BIT: tl.constexpr):
    """Sums over pairs of lanes that differ in ``BIT``, for ``a`` and ``b`` [LANES] at once.

    Lanes without the bit get the sum of ``a``, lanes with it the sum of ``b``. This takes one
    exchange between lanes; two separate sums would take two.
    """
    low = (lane & BIT) == 0
    return tl.where(low, a, b) + tl.gather(tl.where(low, b, a), lane ^ BIT, 0)


@triton.jit
def _sum_over(a, lane, BIT: tl.constexpr):
    """Sums over pairs of lanes that differ in ``BIT``."""
    return a + tl.gather(a, lane ^ BIT, 0)


@triton.jit
def _number_of_sum(lane, ABSOLUTE: tl.constexpr):
    """The number of the sum that ``_sums_over_lanes`` leaves in each lane.

    Also returns a mask of the lanes that store their sum, one lane for each sum.
    """
    four, three, two, one = (lane >> 4) & 1, (lane >> 3) & 1, (lane >> 2) & 1, (lane >> 1) & 1
    if ABSOLUTE:
        further = tl.where(three == 1, 10, 8 + four)
        stores = (lane & 1 == 0) & ((one == 0) | ((two == 0) & (three + four < 2)))
    else:
        further = tl.full([LANES], 8, tl.int32)
        stores = (lane & 1 == 0) & ((one == 0) | (lane == 2))
    return tl.where(one == 0, four + 2 * three + 4 * two, further), stores


@triton.jit
def _sums_over_lanes(sums, lane, ABSOLUTE: tl.constexpr):
    """The sums over all lanes of the nine (or eleven) ``sums``, one in each lane.

    ``_number_of_sum`` says which lane has which sum.
    """
    first = _fold(_fold(sums[0], sums[1], lane, 16), _fold(sums[2], sums[3], lane, 16), lane, 8)
    second = _fold(_fold(sums[4], sums[5], lane, 16), _fold(sums[6], sums[7], lane, 16), lane, 8)
    if ABSOLUTE:
        further = _fold(_fold(sums[8], sums[9], lane, 16), _sum_over(sums[10], lane, 16), lane, 8)
    else:
        further = _sum_over(_sum_over(sums[8], lane, 16), lane, 8)
    return _sum_over(
        _fold(_fold(first, second, lane, 4), _sum_over(further, lane, 4), lane, 2), lane, 1
    )


@triton.jit
def _lane_sums(h, weight, t, dy, g, record, ABSOLUTE: tl.constexpr):
    """The nine (or eleven) gradient sums over each lane's pixels, [LANES], as in a row."""
    ht = h * t
    sum_h, sum_ht = tl.sum(h, 0), tl.sum(ht, 0)
    sum_hy = sum_h * dy  # all pixels of a lane have the same dy
    moments = (sum_h, sum_ht, sum_hy, tl.sum(ht * t, 0), sum_ht * dy, sum_hy * dy)
    colors = (tl.sum(weight * g[0], 0), tl.sum(weight * g[1], 0), tl.sum(weight * g[2], 0))
    if ABSOLUTE:
        # d power / d mean_y = shear a t + e dy, with a and e from the curves: curve = -log2(e)/2 a
        slope = tl.fma(record[2] * record[3], ht, record[4] * (h * dy[None, :]))
        return moments + colors + (tl.sum(tl.abs(ht), 0), tl.sum(tl.abs(slope), 0) * TO_PRECISION)
    else:  # needed: Triton also compiles the code behind a return
        return moments + colors


@triton.jit
def _segment(order, starts, blocks, inner):
    """The block and the first entry of this program's segment.

    Program p of the first ``inner`` has the segment behind border p. Only the list with the entry
    before (p + 1) * SEGMENT can have this border; bisection finds it. If it has no such border, the
    first entry is not before its end. The other programs have the first segments of the blocks in
    ``order``.
    """
    program = tl.program_id(0)
    if program >= inner:
        block = tl.load(order + program - inner).to(tl.int32)
        first = tl.load(starts + block)
    else:
        least = (program + 1) * SEGMENT
        block, above = 0, blocks
        while block + 1 < above:
            middle = (block + above) // 2
            before = tl.load(starts + middle) < least
            block, above = tl.where(before, middle, block), tl.where(before, above, middle)
        begin = tl.load(starts + block)
        first = begin + tl.cdiv(least - begin, SEGMENT) * SEGMENT
    return block, first


@triton.jit
def store_last_slot(slots, last_slots, block, begin, end, mask):
    """Write the slot of the entry before ``end``, -1 if none, to ``last_slots`` [blocks]."""
    slot = tl.load(slots + end - 1, mask=mask & (begin < end), other=-1)
    tl.store(last_slots + block, slot, mask=mask)


@triton.jit(do_not_specialize=["blocks", "inner", "closing", "width", "height", "blocks_x"])
def composite_backward(
    lists,
    pixels,
    slots,
    blocks,
    inner,
    closing,
    width,
    height,
    blocks_x,
    g_image,
    g_alpha,
    rows_out,
    last_slots,
    HAS_ALPHA: tl.constexpr,
    ABSOLUTE: tl.constexpr,
):
    """Write the gradient sums of one segment's pairs, back to front, to ``rows_out`` [pairs, 16].

    c is the colour of a Gaussian, g the gradient of the pixel, T the transmittance before the
    Gaussian, and S the sum of (c . g) alpha T over the later Gaussians and the background. The
    derivative of the loss by alpha is T (c . g) - S / (1 - alpha). Back to front, S is a sum that
    starts with the background and the light behind the segment, so nothing cancels. ``slots``
    [pairs] has the row of each entry. Rows of entries that compositing did not reach are not
    written: see ``last_slots`` at `store_last_slot`. ``g_alpha`` is read only if ``HAS_ALPHA``.
    """
    entries, records, background = lists.entries, lists.records, pixels.background
    block, begin = _segment(pixels.order, lists.starts, blocks, inner)
    steps = tl.arange(0, STEPS)
    places = block_places(steps)
    state = block * BLOCK_PIXELS + places
    seen = tl.load(lists.last + state)
    end = tl.max(tl.max(seen, 0), 0)
    store_last_slot(slots, last_slots, block, begin, end, tl.program_id(0) >= inner)
    # Compositing did not reach this segment.
    if begin >= end:
        return
    inside, pixel, x, y = block_pixels(block, steps, blocks_x, width, height)
    stop = tl.minimum(begin + SEGMENT, end)
    lane = tl.arange(0, LANES)
    number, stores = _number_of_sum(lane, ABSOLUTE)

    g = (
        tl.load(g_image + 3 * pixel, mask=inside, other=0.0),
        tl.load(g_image + 3 * pixel + 1, mask=inside, other=0.0),
        tl.load(g_image + 3 * pixel + 2, mask=inside, other=0.0),
    )
    light = tl.load(pixels.transmittance + state)
    behind = (
        g[0] * tl.load(background) + g[1] * tl.load(background + 1) + g[2] * tl.load(background + 2)
    )
    if HAS_ALPHA:
        behind -= tl.load(g_alpha + pixel, mask=inside, other=0.0)
    behind *= light
    if stop < end:
        # A pixel that stopped before the border has none if another program composited it.
        crossed = seen > stop
        border = pixels.borders + (begin // SEGMENT).to(tl.int64) * BORDER + places
        behind = tl.fma(g[0], tl.load(border + BEHIND_RED, mask=crossed, other=0.0), behind)
        behind = tl.fma(g[1], tl.load(border + BEHIND_GREEN, mask=crossed, other=0.0), behind)
        behind = tl.fma(g[2], tl.load(border + BEHIND_BLUE, mask=crossed, other=0.0), behind)
        light = tl.load(border + TRANSMITTANCE, mask=crossed, other=light)

    ahead = load_record(records, tl.load(entries + stop - 1, mask=begin < stop, other=closing))
    entry = tl.load(entries + stop - 2, mask=begin + 1 < stop, other=closing)
    position = stop
    while position > begin:
        for _ in tl.static_range(UNROLL_BACK):
            position -= 1
            record = ahead
            ahead = load_record(records, entry)
            entry = tl.load(entries + position - 2, mask=position - 2 >= begin, other=closing)
            slot = tl.load(slots + position, mask=position >= begin, other=0)
            power, t, dy = log2_alpha(record, steps, x, y)
            raw = tl.where((power >= LOG2_ALPHA_MIN) & (position < seen), tl.exp2(power), 0.0)
            opacity = tl.minimum(raw, ALPHA_MAX)
            root = tl.rsqrt(1.0 - opacity)
            inverse = root * root  # 1 / (1 - alpha), cheaper than a division
            shine = tl.fma(g[0], record[6], tl.fma(g[1], record[7], g[2] * record[8]))
            h = raw * inverse * tl.fma(light, shine, -behind)
            light *= inverse
            weight = light * opacity
            behind = tl.fma(weight, shine, behind)

            # A pair has a row of its own: no atomics. `sum_units` adds in the order of slots.
            tl.store(
                rows_out + slot * ROW + number,
                _sums_over_lanes(_lane_sums(h, weight, t, dy, g, record, ABSOLUTE), lane, ABSOLUTE),
                mask=stores & (position >= begin),
            )
