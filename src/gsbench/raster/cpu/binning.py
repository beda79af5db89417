"""Lists of the records that each tile composites, front to back.

The records are sorted once by depth. The sorted order is divided into shards; the records of each
shard are counted and written to the lists in that order, so the list of each tile is sorted, too.
Tiles that the contour alpha = 1/255 does not reach are left out, because the Gaussian is invisible
there.
"""

import math

import numpy as np

from gsbench.raster.base import CONSTANTS
from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.simd import prefetch
from gsbench.system.jit import inlined, kernel

LOG2_ALPHA_MIN_MARGIN, PIXEL_MARGIN = CONSTANTS.log2_alpha_margin, CONSTANTS.pixel_margin
LOW_WORD = np.uint64(0xFFFFFFFF)  # the bits of a key that hold the record
AHEAD = 12  # records ahead that are prefetched
TILE_WORK = 16  # fixed work of a tile, in list entries
DIGIT = 11  # bits that one pass of the radix sort handles
BUCKETS = 1 << DIGIT
PASSES = 3  # over the 31 bits of a positive float32


@kernel
def sort_by_depth(begins, visible, keys, order, spare, counts):
    """Sort the ``keys`` of all shards by depth into ``order``.

    Shard s has ``visible[s]`` keys from ``begins[s]`` on. The sort is stable. ``spare`` is as long
    as ``order``; ``counts`` [PASSES, BUCKETS] is scratch. It is a radix sort, lowest digit first
    (Knuth, TAOCP 3, 5.2.5), 3 to 8 times as fast as numpy's sort.
    """
    for digit in range(PASSES):
        for bucket in range(BUCKETS):
            counts[digit, bucket] = 0
    mask = np.uint64(BUCKETS - 1)
    for shard in range(len(begins)):
        for place in range(begins[shard], begins[shard] + visible[shard]):
            depth = keys[place] >> np.uint64(32)
            for digit in range(PASSES):
                counts[digit, (depth >> np.uint64(DIGIT * digit)) & mask] += 1
    for digit in range(PASSES):
        total = 0
        for bucket in range(BUCKETS):
            count = counts[digit, bucket]
            counts[digit, bucket] = total
            total += count
    for shard in range(len(begins)):
        for place in range(begins[shard], begins[shard] + visible[shard]):
            _put(keys[place], 0, counts, order)
    for place in range(len(order)):
        _put(order[place], 1, counts, spare)
    for place in range(len(order)):
        _put(spare[place], 2, counts, order)


@inlined
def _put(key, digit, counts, target):
    bucket = (key >> np.uint64(32 + DIGIT * digit)) & np.uint64(BUCKETS - 1)
    target[counts[digit, bucket]] = key
    counts[digit, bucket] += 1


@inlined
def _columns(records, base, tile_y, first, past, shear, reach, flatness):
    """The first and the past-the-last tile of row ``tile_y`` that the contour reaches.

    Both are within ``first`` to ``past``. The contour is (dx + ``shear`` dy)^2 = ``reach`` -
    ``flatness`` dy^2.
    """
    mean_y = np.float64(records[base + at.MEAN_Y])
    top = tile_y * at.TILE - mean_y - PIXEL_MARGIN
    bottom = top + (at.TILE - 1) + 2 * PIXEL_MARGIN
    # As a function of y, the contour's right side is concave and its left side convex. So the
    # extremes within the row are at the rightmost and the leftmost point, clamped to the row.
    rightmost = np.float64(records[base + at.RIGHTMOST_Y])
    y_right = min(max(rightmost, top), bottom)
    y_left = min(max(-rightmost, top), bottom)
    right = math.sqrt(max(0.0, reach - flatness * y_right * y_right)) - shear * y_right
    left = -math.sqrt(max(0.0, reach - flatness * y_left * y_left)) - shear * y_left
    mean_x = np.float64(records[base + at.MEAN_X])
    low = math.ceil(min(max(mean_x + left - PIXEL_MARGIN, -1e6), 1e6))
    high = math.floor(min(max(mean_x + right + PIXEL_MARGIN, -1e6), 1e6))
    return max(first, int(low) >> 4), min(past, (int(high) >> 4) + 1)


@kernel
def pair_shards(
    first, past, edges, keys, records, record_ints, tiles_x, cutoff, counts, pairs, made
):
    """Write the pairs of tile and record of the shards ``first`` to ``past``.

    A pair has the tile in its high word and the record in its low word. The sorted ``keys`` are
    divided into shards: shard s has those from ``edges[s]`` to before ``edges[s + 1]`` and writes
    to ``pairs[s]``. ``counts[s]`` [tiles] gets the number of pairs of each tile, ``made[s]`` the
    total. Pairs for which ``pairs`` has no room are only counted.
    """
    for shard in range(first, past):
        begin, end = edges[shard], edges[shard + 1]
        made[shard] = _pair(
            begin, end, keys, records, record_ints, tiles_x, cutoff, counts[shard], pairs[shard]
        )


@inlined
def _pair(begin, end, keys, records, record_ints, tiles_x, cutoff, counts, pairs):
    for tile in range(len(counts)):
        counts[tile] = 0
    room = np.uint64(len(pairs))
    place = np.uint64(0)
    for position in range(begin, end):
        prefetch(records, int(keys[min(position + AHEAD, end - 1)] & LOW_WORD) * at.RECORD)
        record = keys[position] & LOW_WORD
        base = int(record) * at.RECORD
        spans_x, spans_y = record_ints[base + at.TILES_X], record_ints[base + at.TILES_Y]
        first, past = spans_x & 0xFFFF, spans_x >> 16
        inverse = 1.0 / np.float64(records[base + at.U_X])
        distance = np.float64(records[base + at.LOG2_OPACITY]) - cutoff + LOG2_ALPHA_MIN_MARGIN
        reach, shear = distance * inverse * inverse, records[base + at.U_Y] * inverse
        flatness = (records[base + at.V_Y] * inverse) ** 2
        for tile_y in range(spans_y & 0xFFFF, spans_y >> 16):
            low, high = first, past
            if past - first > 1:
                low, high = _columns(records, base, tile_y, first, past, shear, reach, flatness)
            for tile in range(tile_y * tiles_x + low, tile_y * tiles_x + high):
                counts[tile] += 1
                if place < room:
                    pairs[place] = (np.uint64(tile) << np.uint64(32)) | record
                place += np.uint64(1)
    return int(place)


@kernel
def start_tiles(counts, starts):
    """Turn ``counts`` into the places where the lists begin.

    ``counts`` [shards, tiles] gets the place of each shard's first entry in the list of each tile;
    ``starts`` [tiles + 1] the place of each tile's first entry, and the end of the last list.
    """
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
def fill_shards(first, past, made, pairs, places, entries):
    """Write the records of the shards ``first`` to ``past`` to the lists of their tiles.

    Shard s has the first ``made[s]`` of ``pairs[s]``. ``places[s]`` [tiles] is the place of its
    next entry in the list of each tile.
    """
    for shard in range(first, past):
        own_pairs, own_places = pairs[shard], places[shard]
        for k in range(np.uint64(made[shard])):
            tile = own_pairs[k] >> np.uint64(32)
            entries[own_places[tile]] = np.int32(own_pairs[k] & LOW_WORD)
            own_places[tile] += 1


@kernel
def balance_tiles(starts, shards, bounds, tile_shard):
    """Divide the tiles into ``shards`` runs of similar work.

    Fills ``bounds`` [shards + 1], the first tile of each shard, and ``tile_shard`` [tiles].
    """
    tiles = len(tile_shard)
    total = starts[tiles] + TILE_WORK * tiles
    tile = 0
    bounds[0] = 0
    for shard in range(shards):
        while tile < tiles and (starts[tile + 1] + TILE_WORK * (tile + 1)) * shards <= total * (
            shard + 1
        ):
            tile_shard[tile] = shard
            tile += 1
        bounds[shard + 1] = tile


@inlined
def shards_of(record_ints, base, tile_shard, tiles_x):
    """The shards of the first and of the last tile that the record at ``base`` can touch."""
    spans_x, spans_y = record_ints[base + at.TILES_X], record_ints[base + at.TILES_Y]
    first = tile_shard[(spans_y & 0xFFFF) * tiles_x + (spans_x & 0xFFFF)]
    last = tile_shard[((spans_y >> 16) - 1) * tiles_x + (spans_x >> 16) - 1]
    return np.int64(first), np.int64(last)


@kernel
def place_rows(begins, visible, record_ints, tile_shard, tiles_x):
    """Write `layout.FIRST_ROW` of all records; return the number of rows.

    Shard s has ``visible[s]`` records from ``begins[s]`` on. The rows of a record are adjacent, and
    follow those of the record before. Its row of a shard of tiles is ``FIRST_ROW`` + shard.
    """
    row = 0
    for shard in range(len(begins)):
        for record in range(begins[shard], begins[shard] + visible[shard]):
            base = record * at.RECORD
            first, last = shards_of(record_ints, base, tile_shard, tiles_x)
            record_ints[base + at.FIRST_ROW] = row - first
            row += last - first + 1
    return row
