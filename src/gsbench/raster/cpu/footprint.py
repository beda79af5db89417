"""Footprints, the pixels that each Gaussian was blended into, from the forward pass's output; run on request."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.composite import LOG2_ALPHA_MIN, ONE, PIXEL_X, PIXEL_Y, ZERO, place_in_tile
from gsbench.raster.cpu.simd import fma, lane_sums, load, lowest_bit, select, splat, square_root, store
from gsbench.raster.cpu.vector import LANES
from gsbench.system.jit import kernel

# Of a Gaussian's row: how many pixels, the sum of their values, and of their distances; as ``lane_sums`` leaves them.
COVERED, VALUES, DISTANCES = at.SUM_H, at.SUM_H_T, at.SUM_H_Y


@kernel
def cover_tiles(
    memory: Any,
    first: int,
    past: int,
    frame: Any,
    values: Any,
    covered: Any,
    sums: Any,
    distances: Any,
) -> None:
    """Add the tiles ``first`` to ``past`` to ``covered`` [N] int32, ``sums`` and ``distances`` [N] of their shards.

    ``values`` [H * W] may be empty for zero. The arithmetic of the compositing kernels decides here too which pixels
    are blended.
    """
    entries, masks, records = frame.entries, frame.masks, frame.records
    tiles_x, width, height = frame.camera.tiles_x, frame.camera.width, frame.camera.height
    floats, _ = memory
    one = splat(ONE)
    own, row = floats[: at.TILE_PIXELS], floats[at.TILE_PIXELS :]
    for tile in range(first, past):
        left, top = tile % tiles_x * at.TILE, tile // tiles_x * at.TILE
        tile_x, tile_y = np.float32(left), np.float32(top)
        state = tile * at.TILE_PIXELS
        begin = frame.starts[tile]
        for pixel in range(at.TILE_PIXELS):
            own[pixel] = ZERO
        if len(values) > 0:
            for y in range(top, min(top + at.TILE, height)):
                for x in range(left, min(left + at.TILE, width)):
                    own[place_in_tile(x - left, y - top)] = values[y * width + x]
        for entry in range(begin, frame.processed[tile]):
            todo = np.uint64(masks[entry])
            if todo == 0:
                continue
            base = entries[entry] * at.RECORD
            shear = splat(records[base + at.SHEAR])
            curve_t, curve_y = splat(records[base + at.CURVE_T]), splat(records[base + at.CURVE_Y])
            log2_opacity = splat(records[base + at.LOG2_OPACITY])
            offset_x, offset_y = tile_x - records[base + at.MEAN_X], tile_y - records[base + at.MEAN_Y]
            number = splat(np.float32(entry - begin + 1))
            count, total, reach = splat(ZERO), splat(ZERO), splat(ZERO)
            while todo != 0:
                block = lowest_bit(todo)
                todo &= todo - np.uint64(1)
                place = block * np.uint64(LANES)
                dx = load(PIXEL_X, place) + offset_x
                dy = load(PIXEL_Y, place) + offset_y
                t = fma(dy, shear, dx)
                power = fma(curve_y * dy, dy, fma(curve_t * t, t, log2_opacity))
                blended = (power >= LOG2_ALPHA_MIN) & (number <= load(frame.last, state + place))
                count += select(blended, one, ZERO)
                total += select(blended, load(own, place), ZERO)
                reach += select(blended, square_root(fma(dx, dx, dy * dy)), ZERO)
            shard, index = frame.tile_shard[tile], frame.record_ints[base + at.INDEX]
            store(row, 0, lane_sums((count, total, reach)))
            covered[shard, index] += np.int32(row[COVERED])
            sums[shard, index] += row[VALUES]
            distances[shard, index] += row[DISTANCES]
