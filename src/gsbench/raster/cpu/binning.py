"""Lists of the records that each tile composites, front to back.

The records are sorted once by depth; shards of the sorted order are then counted and filled in that order, so the list
of every tile comes out sorted. A tile that the contour alpha = 1/255 does not reach is left out: nothing there could be
seen.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.jit import inlined, kernel
from gsbench.raster.cpu.simd import prefetch

LOG2_ALPHA_MIN_MARGIN = 1e-3  # of the contour's reach, for float32
PIXEL_MARGIN = 0.02  # px
LOW_WORD = np.uint64(0xFFFFFFFF)  # of a key: the record
AHEAD = 12  # records that the prefetch runs ahead
TILE_WORK = 16  # list entries that the fixed work of a tile weighs


@inlined
def _columns(records: Any, base: int, tile_y: int, first: int, past: int, cutoff: Any) -> Any:
    """Tiles of row ``tile_y``, within ``first`` to ``past``, that the contour reaches: first, past the last."""
    shear, mean_y = np.float64(records[base + at.SHEAR]), np.float64(records[base + at.MEAN_Y])
    curve_t, curve_y = np.float64(records[base + at.CURVE_T]), np.float64(records[base + at.CURVE_Y])
    reach = np.float64(records[base + at.LOG2_OPACITY]) - cutoff + LOG2_ALPHA_MIN_MARGIN
    top = tile_y * at.TILE - mean_y - PIXEL_MARGIN
    bottom = top + (at.TILE - 1) + 2 * PIXEL_MARGIN
    # The contour's x over y is concave on the right and convex on the left: the extremes within the row are at its
    # rightmost and leftmost points, clamped to the row.
    rightmost = np.float64(records[base + at.RIGHTMOST_Y])
    y_right = min(max(rightmost, top), bottom)
    y_left = min(max(-rightmost, top), bottom)
    right = math.sqrt(max(0.0, (reach + curve_y * y_right * y_right) / -curve_t)) - shear * y_right
    left = -math.sqrt(max(0.0, (reach + curve_y * y_left * y_left) / -curve_t)) - shear * y_left
    mean_x = np.float64(records[base + at.MEAN_X])
    low = math.ceil(min(max(mean_x + left - PIXEL_MARGIN, -1e6), 1e6))
    high = math.floor(min(max(mean_x + right + PIXEL_MARGIN, -1e6), 1e6))
    return max(first, int(low) >> 4), min(past, (int(high) >> 4) + 1)


@kernel
def count_shard(
    begin: int, end: int, keys: Any, records: Any, record_ints: Any, tiles_x: int, cutoff: Any, counts: Any
) -> None:
    """Add to ``counts`` [tiles] the records of the sorted ``keys`` ``begin`` to ``end``."""
    for tile in range(len(counts)):
        counts[tile] = 0
    for position in range(begin, end):
        prefetch(records, int(keys[min(position + AHEAD, end - 1)] & LOW_WORD) * at.RECORD)
        base = int(keys[position] & LOW_WORD) * at.RECORD
        spans_x, spans_y = record_ints[base + at.TILES_X], record_ints[base + at.TILES_Y]
        first, past = spans_x & 0xFFFF, spans_x >> 16
        for tile_y in range(spans_y & 0xFFFF, spans_y >> 16):
            low, high = first, past
            if past - first > 1:
                low, high = _columns(records, base, tile_y, first, past, cutoff)
            for tile in range(tile_y * tiles_x + low, tile_y * tiles_x + high):
                counts[tile] += 1


@kernel
def start_tiles(counts: Any, starts: Any) -> None:
    """Turn ``counts`` [shards, tiles] into places of first entries; ``starts`` [tiles + 1] gets those of tiles."""
    shards, tiles = counts.shape
    place = 0
    for tile in range(tiles):
        starts[tile] = place
        for shard in range(shards):
            count = counts[shard, tile]
            counts[shard, tile] = place
            place += count
    starts[tiles] = place


@kernel
def fill_shard(
    begin: int,
    end: int,
    keys: Any,
    records: Any,
    record_ints: Any,
    tiles_x: int,
    cutoff: Any,
    places: Any,
    entries: Any,
) -> None:
    """Write the records of the sorted ``keys`` ``begin`` to ``end`` to their tiles' lists, at ``places`` [tiles]."""
    for position in range(begin, end):
        prefetch(records, int(keys[min(position + AHEAD, end - 1)] & LOW_WORD) * at.RECORD)
        record = int(keys[position] & LOW_WORD)
        base = record * at.RECORD
        spans_x, spans_y = record_ints[base + at.TILES_X], record_ints[base + at.TILES_Y]
        first, past = spans_x & 0xFFFF, spans_x >> 16
        for tile_y in range(spans_y & 0xFFFF, spans_y >> 16):
            low, high = first, past
            if past - first > 1:
                low, high = _columns(records, base, tile_y, first, past, cutoff)
            for tile in range(tile_y * tiles_x + low, tile_y * tiles_x + high):
                entries[places[tile]] = record
                places[tile] += 1


@kernel
def balance_tiles(starts: Any, shards: int, bounds: Any, tile_shard: Any) -> None:
    """Cut the tiles into ``shards`` runs of about equal work: ``bounds`` [shards + 1], and the run of each tile."""
    tiles = len(tile_shard)
    total = starts[tiles] + TILE_WORK * tiles
    tile = 0
    bounds[0] = 0
    for shard in range(shards):
        while tile < tiles and (starts[tile + 1] + TILE_WORK * (tile + 1)) * shards <= total * (shard + 1):
            tile_shard[tile] = shard
            tile += 1
        if shard == shards - 1:
            while tile < tiles:
                tile_shard[tile] = shard
                tile += 1
        bounds[shard + 1] = tile
