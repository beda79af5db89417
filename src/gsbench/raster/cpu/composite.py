"""Compositing of tiles, forward and backward, 4x4 pixels at a time; and footprints.

A tile is 16 blocks of 4x4 pixels. The state of a block is one vector per quantity. For each entry
of a tile's list, a bit mask says which blocks the record may touch; the forward pass stores it in
``masks`` for the backward pass.

The formulas are those of 3DGS (Kerbl et al. 2023, eq. 2 to 4; renderCUDA in its code). With the
density G, the opacity o and the colour c of each record, front to back,

    alpha = min(0.99, o G),  skipped below 1/255
    image = sum of c alpha T + background T_end,  T = product of (1 - alpha) of the records before

and a pixel stops before the record that would lower T below 1e-4. Densities are powers of 2 here,
because `simd.exp2` is an exponential in few instructions; numba would call one per lane.
"""

import math

import numpy as np

from gsbench.raster.base import CONSTANTS
from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.shuffle import BLOCK, CHANNELS, load_colors, store_block, store_colors
from gsbench.raster.cpu.simd import (
    LANES,
    absolute,
    exp2,
    fma,
    lane_sums,
    lanes_with_bit,
    load,
    lowest_bit,
    mask_bits,
    mask_from_bits,
    maximum,
    minimum,
    prefetch,
    select,
    splat,
    square_root,
    store,
)
from gsbench.system.jit import inlined, kernel

LOG2_ALPHA_MIN = np.float32(math.log2(CONSTANTS.alpha_min))
ALPHA_MAX = np.float32(CONSTANTS.alpha_max)
TRANSMITTANCE_MIN = np.float32(CONSTANTS.transmittance_min)
# A block is kept if its largest alpha is almost 1/255: rounding must not lose a pixel.
LOG2_BLOCK_MIN = np.float32(math.log2(CONSTANTS.alpha_min) - 0.01)
ONE = np.float32(1)
ZERO = np.float32(0)
SIDE, BLOCK_SPAN = np.float32(BLOCK), np.float32(BLOCK - 1)
# entries that the forward pass blends at a time, block by block: the number of bits of a word
BATCH = 64
# places of an entry's numbers in a batch: u and v by lane, u and v by block, the record
V_BY_LANE, U_BY_BLOCK, V_BY_BLOCK, RECORD, COPY = (k * LANES for k in range(1, 6))
BATCH_AHEAD = 24  # entries ahead that the forward pass prefetches
AHEAD = 6  # entries ahead that the backward pass prefetches; it works longer on each
NEVER_STOPPED = np.float32(1e9)  # larger than the number of entries of any tile
# Lanes of a footprint's row: number of pixels, sum of values, sum of distances; in the order of
# ``lane_sums``.
COVERED, VALUES, DISTANCES = at.SUM_H, at.SUM_H_U, at.SUM_H_V

LANE_X = (np.arange(LANES) % BLOCK).astype(np.float32)  # px within a block
LANE_Y = (np.arange(LANES) // BLOCK).astype(np.float32)


@inlined
def _origin(tile, tiles_x):
    """The column and row of the first pixel of a tile."""
    return tile % tiles_x * at.TILE, tile // tiles_x * at.TILE


@inlined
def _corner(block, left, top):
    """The column and row of the first pixel of a block in the tile that starts at (left, top)."""
    return left + block % 4 * BLOCK, top + block // 4 * BLOCK


@inlined
def _planes(floats):
    """The memory of red, green and blue of a tile, by block and lane."""
    return floats[: at.TILE_PIXELS], floats[at.TILE_PIXELS :], floats[2 * at.TILE_PIXELS :]


@inlined
def _load_planes(planes, place):
    return load(planes[0], place), load(planes[1], place), load(planes[2], place)


@inlined
def _store_planes(planes, place, red, green, blue):
    store(planes[0], place, red)
    store(planes[1], place, green)
    store(planes[2], place, blue)


@inlined
def _from_mean(records, base, left, top):
    """The vector (dx, dy) from the mean of a record to the pixel (left, top)."""
    return np.float32(left) - records[base + at.MEAN_X], np.float32(top) - records[base + at.MEAN_Y]


@inlined
def _coordinates(records, base, dx, dy, by_block, place):
    """u and v of a record (`layout`) in a tile whose first pixel is (dx, dy) away from the mean.

    A pixel's u is the sum of a number for its lane and one for its block, and so is its v. Returns
    u and v by lane; writes u by block, then v, to ``by_block`` at ``place``.
    """
    u_x, u_y, v_y = records[base + at.U_X], records[base + at.U_Y], records[base + at.V_Y]
    u = fma(load(LANE_Y, 0), u_y, load(LANE_X, 0) * u_x)
    v = load(LANE_Y, 0) * v_y
    # Block b lies in the tile as lane b lies in a block, ``SIDE`` times as far.
    store(by_block, place, fma(u, SIDE, u_x * dx + u_y * dy))
    store(by_block, place + LANES, fma(v, SIDE, v_y * dy))
    return u, v


@inlined
def _log2_alpha(u, v, log2_opacity):
    """log2(alpha) before the clamp.

    All kernels call this function and `_coordinates`, so that they round alike and blend the same
    pixels.
    """
    return fma(-v, v, fma(-u, u, log2_opacity))


@inlined
def _at_block(frame, base, block, lanes, by_block, number, state):
    """u, v and log2(alpha) of a record in a block, and where the forward pass blended it.

    ``lanes`` and ``by_block`` are from `_coordinates`; ``number`` counts the entries of the tile's
    list up to the record.
    """
    u, v = lanes[0] + by_block[block], lanes[1] + by_block[block + np.uint64(LANES)]
    power = _log2_alpha(u, v, frame.records[base + at.LOG2_OPACITY])
    last = load(frame.last, state + block * np.uint64(LANES))
    return u, v, power, (power >= LOG2_ALPHA_MIN) & (number <= last)


@inlined
def _touched_blocks(records, base, dx, dy):
    """The blocks of a tile that may have a pixel with alpha >= 1/255.

    The first pixel of the tile is (dx, dy) away from the mean. Returns block b in bit b. Within a
    block, alpha is largest at the mean or, if the mean is outside, on an edge that faces the mean.
    The maximum on a vertical or horizontal line has a closed form, which is clamped to the block.
    The function computes all blocks at once: lane b is block b.
    """
    u_x, u_y, v_y = records[base + at.U_X], records[base + at.U_Y], records[base + at.V_Y]
    # [16] dx of the first column of each block, dy of its first row
    left, top = fma(load(LANE_X, 0), SIDE, dx), fma(load(LANE_Y, 0), SIDE, dy)
    edge_x = _nearest_to_zero(left, BLOCK_SPAN)
    edge_y = _nearest_to_zero(top, BLOCK_SPAN)
    # dy of the best point on the vertical edge
    on_x = maximum(top, minimum(top + BLOCK_SPAN, edge_x * records[base + at.SLOPE]))
    u, v = fma(on_x, u_y, edge_x * u_x), on_x * v_y
    vertical = fma(u, u, v * v)
    # on the horizontal edge, u grows with dx
    u, v = _nearest_to_zero(fma(edge_y, u_y, left * u_x), BLOCK_SPAN * u_x), edge_y * v_y
    horizontal = fma(u, u, v * v)
    reach = records[base + at.LOG2_OPACITY] - LOG2_BLOCK_MIN
    return mask_bits(minimum(vertical, horizontal) <= reach)


@inlined
def _nearest_to_zero(low, span):
    """The number nearest to 0 from ``low`` to ``low + span``."""
    return maximum(low, minimum(low + span, ZERO))


@kernel
def composite_tiles(first, past, memory, frame, image, alpha):
    """Blend the shards ``first`` to ``past`` into ``image`` [H * W * 3] and ``alpha`` [H * W].

    It fills ``masks``, ``processed``, ``transmittance`` and ``last`` of ``frame`` for the backward
    pass. ``last`` is `NEVER_STOPPED` for pixels that no entry stopped, and 0 outside the image.
    """
    floats, integers = memory[0][first], memory[1][first]
    planes, batch = _planes(floats), floats[3 * at.TILE_PIXELS :]  # batch: [BATCH * COPY]
    # [16] pixels that have not stopped, by block; [BATCH] blocks, by entry
    live, touched = integers[:LANES], integers[LANES:].view(np.uint16)
    for tile in range(frame.bounds[first], frame.bounds[past]):
        left, top = _origin(tile, frame.camera.tiles_x)
        state = tile * at.TILE_PIXELS
        alive = _start_blocks(left, top, state, frame, planes, live)
        # Entries are blended in batches, and within a batch block by block. So the state of a block
        # stays in registers for a whole batch; entry by entry, it would be loaded and stored for
        # every entry, and each load would wait for the store before it. The first loop has no
        # branch that depends on a record, so no branch is mispredicted. It also brings the records
        # into the first-level cache, where the second loop reads them up to 16 times.
        begin, end = frame.starts[tile], frame.starts[tile + 1]
        entry = begin
        while entry < end and alive != 0:
            count = min(BATCH, end - entry)
            _gather_batch(entry, count, end, left, top, alive, frame, batch, touched)
            blocks = alive
            while blocks != 0:
                block = lowest_bit(blocks)
                blocks &= blocks - np.uint64(1)
                # bit k: entry k of the batch touches this block
                todo = lanes_with_bit(touched, 0, np.uint64(1) << block)
                if todo != 0:
                    alive = _blend_batch(
                        block, todo, entry, entry - begin, state, frame, planes, batch, live, alive
                    )
            entry += count
        frame.processed[tile] = entry
        _write_blocks(left, top, state, frame, planes, image, alpha)


@inlined
def _start_blocks(left, top, state, frame, planes, live):
    """Start the blocks of a tile: T = 1, no colour; return the blocks with a pixel as bits."""
    width, height = frame.camera.width, frame.camera.height
    lane_x, lane_y = load(LANE_X, 0), load(LANE_Y, 0)
    alive = np.uint64(0)
    for block in range(16):
        place = block * LANES
        _store_planes(planes, place, splat(ZERO), splat(ZERO), splat(ZERO))
        store(frame.transmittance, state + place, splat(ONE))
        x, y = _corner(block, left, top)
        inside = (lane_x < np.float32(width - x)) & (lane_y < np.float32(height - y))
        live[block] = mask_bits(inside)
        # 0 tells the backward pass that nothing was blended into a pixel outside the image.
        store(frame.last, state + place, select(inside, splat(NEVER_STOPPED), ZERO))
        if live[block] != 0:
            alive |= np.uint64(1) << np.uint64(block)
    return alive


@inlined
def _gather_batch(entry, count, end, left, top, alive, frame, batch, touched):
    """Copy the records of ``count`` entries from ``entry``; fill ``touched`` and ``frame.masks``.

    A copy has the coordinates of a record in the tile, then the record.
    """
    entries, records = frame.entries, frame.records
    for k in range(count):
        base, copy = entries[entry + k] * at.RECORD, k * COPY
        prefetch(records, entries[min(entry + k + BATCH_AHEAD, end - 1)] * at.RECORD)
        dx, dy = _from_mean(records, base, left, top)
        blocks = _touched_blocks(records, base, dx, dy) & alive
        touched[k] = blocks
        frame.masks[entry + k] = blocks
        u, v = _coordinates(records, base, dx, dy, batch, copy + U_BY_BLOCK)
        store(batch, copy, u)
        store(batch, copy + V_BY_LANE, v)
        store(batch, copy + RECORD, load(records, base))
    # ``lanes_with_bit`` reads a whole batch: what is behind the end of the list touches nothing.
    for k in range(count, BATCH):
        touched[k] = 0


@inlined
def _blend_batch(block, todo, entry, before_batch, state, frame, planes, batch, live, alive):
    """Blend the entries ``todo`` of the batch at ``entry`` into a block; return ``alive``.

    The list of the tile has ``before_batch`` entries before the batch.
    """
    bit = np.uint64(1) << block
    place = block * np.uint64(LANES)
    before = load(frame.transmittance, state + place)
    r, g, b = _load_planes(planes, place)
    lanes = mask_from_bits(live[block])
    while todo != 0:
        k = lowest_bit(todo)
        todo &= todo - np.uint64(1)
        copy = k * np.uint64(COPY)
        base = copy + np.uint64(RECORD)
        power = _log2_alpha(
            load(batch, copy) + batch[copy + block + np.uint64(U_BY_BLOCK)],
            load(batch, copy + np.uint64(V_BY_LANE)) + batch[copy + block + np.uint64(V_BY_BLOCK)],
            batch[base + np.uint64(at.LOG2_OPACITY)],
        )
        blend = (power >= LOG2_ALPHA_MIN) & lanes
        weight = select(blend, before * minimum(exp2(power), splat(ALPHA_MAX)), ZERO)
        after = before - weight
        stop = after < TRANSMITTANCE_MIN
        stopped = mask_bits(stop)
        # Few entries stop a pixel: only these pay for the memory of ``last`` and ``live``.
        if stopped != 0:
            number = splat(np.float32(before_batch + np.int64(k)))
            earlier = load(frame.last, state + place)
            store(frame.last, state + place, select(stop, number, earlier))
            live[block] &= ~np.int64(stopped)
            lanes = mask_from_bits(live[block])
            weight = select(stop, ZERO, weight)
            after = select(stop, before, after)
            if live[block] == 0:
                alive &= ~bit
                # later entries do not change this block: the backward pass skips them
                while todo != 0:
                    frame.masks[entry + np.int64(lowest_bit(todo))] &= ~bit
                    todo &= todo - np.uint64(1)
        r = fma(weight, batch[base + np.uint64(at.RED)], r)
        g = fma(weight, batch[base + np.uint64(at.GREEN)], g)
        b = fma(weight, batch[base + np.uint64(at.BLUE)], b)
        before = after
    store(frame.transmittance, state + place, before)
    _store_planes(planes, place, r, g, b)
    return alive


@inlined
def _write_blocks(left, top, state, frame, planes, image, alpha):
    """Add the background behind a tile and write its pixels to the image."""
    width, height = frame.camera.width, frame.camera.height
    for block in range(16):
        place = block * LANES
        x, y = _corner(block, left, top)
        behind = load(frame.transmittance, state + place)
        r, g, b = _load_planes(planes, place)
        r = fma(behind, frame.background[0], r)
        g = fma(behind, frame.background[1], g)
        b = fma(behind, frame.background[2], b)
        if x + BLOCK <= width and y + BLOCK <= height:
            pixel = y * width + x
            store_colors(image, CHANNELS * pixel, CHANNELS * width, r, g, b)
            store_block(alpha, pixel, width, ONE - behind)
            continue
        _store_planes(planes, place, r, g, b)
        for lane in range(LANES):  # a block across the image's edge
            if x + lane % 4 < width and y + lane // 4 < height:
                pixel = (y + lane // 4) * width + x + lane % 4
                for channel in range(CHANNELS):
                    image[CHANNELS * pixel + channel] = planes[channel][place + lane]
                alpha[pixel] = ONE - frame.transmittance[state + place + lane]


@inlined
def place_in_tile(x, y):
    """The index of pixel (x, y) of a tile in the order by block and lane."""
    return (((y >> 2) * 4 + (x >> 2)) << 4) + (y & 3) * 4 + (x & 3)


@kernel
def composite_backward_tiles(first, past, memory, frame, g_image, g_alpha, rows, want_absolute):
    """Add the gradient sums of the shards ``first`` to ``past``, back to front, to ``rows``.

    c is the colour of a record, g the gradient of the pixel, T the transmittance before the record.
    U is the sum over the later records and the background of (c . g) alpha T, divided by the
    transmittance behind the record. The derivative of the loss by the record's alpha is T (c . g -
    U), and U for the previous record is U + alpha (c . g - U). So, back to front, U is a sequence
    of weighted means that starts with the background: nothing cancels, and the only division per
    record is that for T.

    Each record has one of the ``rows`` [rows * 16] for each shard of tiles (`layout`). If
    ``g_alpha`` is empty, the gradient by alpha is 0. ``want_absolute`` is True or None, so that
    numba removes its branch at compilation.
    """
    entries, masks, records = frame.entries, frame.masks, frame.records
    record_ints = frame.record_ints
    floats = memory[0][first]
    planes = _planes(floats)  # the gradient of the image
    # U, and T behind the current record
    behind, through = floats[3 * at.TILE_PIXELS :], floats[4 * at.TILE_PIXELS :]
    by_block = floats[5 * at.TILE_PIXELS :]  # u, then v
    for tile in range(frame.bounds[first], frame.bounds[past]):
        shard = np.int64(frame.tile_shard[tile])
        left, top = _origin(tile, frame.camera.tiles_x)
        state = tile * at.TILE_PIXELS
        begin, end = frame.starts[tile], frame.processed[tile]
        if begin == end:
            continue
        _start_backward(left, top, state, frame, g_image, g_alpha, planes, behind, through)
        for entry in range(end - 1, begin - 1, -1):
            prefetch(records, entries[max(entry - 2 * AHEAD, begin)] * at.RECORD)
            ahead = entries[max(entry - AHEAD, begin)] * at.RECORD
            prefetch(rows, (record_ints[ahead + at.FIRST_ROW] + shard) * at.ROW)
            todo = np.uint64(masks[entry])
            if todo == 0:
                continue
            base = entries[entry] * at.RECORD
            dx, dy = _from_mean(records, base, left, top)
            lanes = _coordinates(records, base, dx, dy, by_block, 0)
            number = splat(np.float32(entry - begin + 1))
            zero = splat(ZERO)
            sums = (zero, zero, zero, zero, zero, zero, zero, zero, zero)
            sum_abs_u, sum_abs_y = zero, zero
            while todo != 0:
                block = lowest_bit(todo)
                todo &= todo - np.uint64(1)
                place = block * np.uint64(LANES)
                u, v, power, blended = _at_block(frame, base, block, lanes, by_block, number, state)
                raw = select(blended, exp2(power), ZERO)
                g = _load_planes(planes, place)
                h, weight = _pull(records, base, place, raw, g, behind, through)
                hu, hv = h * u, h * v
                sums = _add_moments(sums, h, hu, hv, u, v, weight, g)
                if want_absolute is not None:
                    sum_abs_u += absolute(hu)
                    # d power / d mean_y, divided by 2 ln 2
                    sum_abs_y += absolute(
                        fma(hu, records[base + at.U_Y], hv * records[base + at.V_Y])
                    )
            if want_absolute is not None:
                total = lane_sums((*sums, sum_abs_u, sum_abs_y))
            else:
                total = lane_sums(sums)
            # No atomics: a shard of tiles is run by one thread, which alone writes to these rows.
            row = (record_ints[base + at.FIRST_ROW] + shard) * at.ROW
            store(rows, row, load(rows, row) + total)


@inlined
def _pull(records, base, place, raw, g, behind, through):
    """d loss / d log(alpha) and the weight alpha T of a record in a block; move U and T on.

    ``raw`` is alpha before the clamp to 0.99, 0 where the record was not blended; the gradient
    passes the clamp, as in 3DGS. ``g`` is the gradient of the pixels.
    """
    opacity = minimum(raw, splat(ALPHA_MAX))
    before = load(through, place) / (ONE - opacity)
    light = fma(g[1], records[base + at.GREEN], g[2] * records[base + at.BLUE])
    light = fma(g[0], records[base + at.RED], light)  # c . g
    later = load(behind, place)
    gain = light - later
    store(behind, place, fma(opacity, gain, later))
    store(through, place, before)
    return before * (raw * gain), before * opacity


@inlined
def _add_moments(sums, h, hu, hv, u, v, weight, g):
    """The first nine sums of a gradient row (`layout`) with those of one more block."""
    return (
        sums[0] + h,
        sums[1] + hu,
        sums[2] + hv,
        fma(hu, u, sums[3]),
        fma(hu, v, sums[4]),
        fma(hv, v, sums[5]),
        fma(weight, g[0], sums[6]),
        fma(weight, g[1], sums[7]),
        fma(weight, g[2], sums[8]),
    )


@inlined
def _start_backward(left, top, state, frame, g_image, g_alpha, planes, behind, through):
    """Load the gradient of a tile's pixels, and start U with the background and T with T_end."""
    width, height = frame.camera.width, frame.camera.height
    for block in range(16):
        place = block * LANES
        x, y = _corner(block, left, top)
        if x + BLOCK <= width and y + BLOCK <= height:
            r, g, b = load_colors(g_image, CHANNELS * (y * width + x), CHANNELS * width)
            _store_planes(planes, place, r, g, b)
            continue
        for lane in range(LANES):  # a block across the image's edge
            inside = x + lane % 4 < width and y + lane // 4 < height
            pixel = (y + lane // 4) * width + x + lane % 4
            for channel in range(CHANNELS):
                value = g_image[CHANNELS * pixel + channel] if inside else ZERO
                planes[channel][place + lane] = value
    _place_image(g_alpha, left, top, width, height, behind)
    for place in range(0, at.TILE_PIXELS, LANES):
        final = load(frame.transmittance, state + place)
        red, green, blue = _load_planes(planes, place)
        light = fma(red, frame.background[0], -load(behind, place))
        light = fma(green, frame.background[1], light)
        store(behind, place, fma(blue, frame.background[2], light))
        store(through, place, final)


@inlined
def _place_image(image, left, top, width, height, out):
    """Copy the pixels of a tile from ``image`` [H * W] to ``out``, by block and lane.

    Pixels outside the image are 0, as are all of an empty ``image``.
    """
    for pixel in range(at.TILE_PIXELS):
        out[pixel] = ZERO
    if len(image) > 0:
        for y in range(top, min(top + at.TILE, height)):
            for x in range(left, min(left + at.TILE, width)):
                out[place_in_tile(x - left, y - top)] = image[y * width + x]


@kernel
def cover_tiles(first, past, memory, frame, values, covered, sums, distances):
    """Add the footprints of the shards of tiles ``first`` to ``past`` to their sums.

    The sums are ``covered`` [shards, N] int32, ``sums`` and ``distances`` [shards, N]. ``values``
    is [H * W]; if it is empty, all values are 0.
    """
    entries, masks, records = frame.entries, frame.masks, frame.records
    floats = memory[0][first]
    own, totals = floats[: at.TILE_PIXELS], floats[at.TILE_PIXELS :]
    by_block = floats[2 * at.TILE_PIXELS :]  # u, then v
    for tile in range(frame.bounds[first], frame.bounds[past]):
        left, top = _origin(tile, frame.camera.tiles_x)
        state = tile * at.TILE_PIXELS
        begin = frame.starts[tile]
        _place_image(values, left, top, frame.camera.width, frame.camera.height, own)
        for entry in range(begin, frame.processed[tile]):
            todo = np.uint64(masks[entry])
            if todo == 0:
                continue
            base = entries[entry] * at.RECORD
            dx, dy = _from_mean(records, base, left, top)
            lanes = _coordinates(records, base, dx, dy, by_block, 0)
            number = splat(np.float32(entry - begin + 1))
            count, total, reach = splat(ZERO), splat(ZERO), splat(ZERO)
            while todo != 0:
                block = lowest_bit(todo)
                todo &= todo - np.uint64(1)
                place = block * np.uint64(LANES)
                _, _, _, blended = _at_block(frame, base, block, lanes, by_block, number, state)
                column, row = _corner(np.int64(block), dx, dy)
                x, y = load(LANE_X, 0) + np.float32(column), load(LANE_Y, 0) + np.float32(row)
                count += select(blended, splat(ONE), ZERO)
                total += select(blended, load(own, place), ZERO)
                reach += select(blended, square_root(fma(x, x, y * y)), ZERO)
            shard, index = frame.tile_shard[tile], frame.record_ints[base + at.INDEX]
            store(totals, 0, lane_sums((count, total, reach)))
            covered[shard, index] += np.int32(totals[COVERED])
            sums[shard, index] += totals[VALUES]
            distances[shard, index] += totals[DISTANCES]
