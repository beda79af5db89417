"""Projection of Gaussians to records.

Of a shard, the Gaussians ``begin`` to ``end``, the visible ones become the records ``begin``, ``begin + 1``, ... in the
order of their index.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gsbench.raster.base import CONSTANTS
from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.geometry import (
    LOG2_E,
    dot,
    exponential,
    from_camera,
    gather_quaternions,
    gather_vectors,
    image_axes,
    normalized,
    rotation_matrix,
    scaled,
    spread,
    times,
    to_view,
)
from gsbench.raster.cpu.harmonics import F0, MATRIX, fill_basis
from gsbench.raster.cpu.shuffle import REST, as_integers, as_span, by_channel, index_bits, load_rest, transpose
from gsbench.raster.cpu.simd import (
    absolute,
    ceil,
    floor,
    gather,
    load,
    log2,
    lowest_bit,
    mask_bits,
    maximum,
    minimum,
    select,
    splat,
    square_root,
    store,
)
from gsbench.raster.cpu.vector import LANES
from gsbench.raster.validate import MIN_QUATERNION_NORM
from gsbench.system.jit import inlined, kernel

NEAR, SIGMA_EXTENT, EIGENVALUE_FLOOR = CONSTANTS.near, CONSTANTS.sigma_extent, CONSTANTS.eigenvalue_floor
ALPHA_MIN, LOG2_ALPHA_MIN = CONSTANTS.alpha_min, math.log2(CONSTANTS.alpha_min)
MAX_RADIUS = 2.0**24  # px; keeps the radius of an absurdly large Gaussian inside int32
MAX_CENTER = 1e9  # px; a centre so far outside the image cannot be told apart in float32
MAX_VARIANCE = 1e18  # px^2; nor can a standard deviation; squares stay finite
CONTOUR_MARGIN = 0.01  # px, and relative: rounding of the contour alpha = 1/255 must not lose a pixel
ZERO, HALF, ONE, TWO, FOUR = (np.float32(value) for value in (0, 0.5, 1, 2, 4))

ALL_LANES = np.uint64((1 << LANES) - 1)
VISIBLE, BAD_VALUE = 0, 1  # places of a shard's flags


@inlined
def _tile_range(low: Any, high: Any, tiles: int) -> Any:
    """First and past-the-last tile for the pixels ``low`` to ``high`` - 1, within the grid."""
    first = floor(minimum(maximum(low * (1.0 / at.TILE), ZERO), np.float32(tiles)))
    past = floor(minimum(maximum((high + (at.TILE - 1)) * (1.0 / at.TILE), ZERO), np.float32(tiles)))
    return first, past


@kernel
def project_shards(
    memory: Any,
    first: int,
    past: int,
    edges: Any,
    gaussians: Any,
    degree: int,
    v: Any,
    records: Any,
    record_ints: Any,
    keys: Any,
    radii: Any,
    flags: Any,
) -> None:
    """Fill, for the shards ``first`` to ``past`` between ``edges``, ``records`` [N * 16], ``keys`` [N] (depth, then
    record), ``radii`` [N], and two ``flags`` a shard."""
    for shard in range(first, past):
        begin, end = edges[shard], edges[shard + 1]
        _project(memory, begin, end, gaussians, degree, v, records, record_ints, keys, radii, flags[shard])


@inlined
def _project(
    memory: Any,
    begin: int,
    end: int,
    gaussians: Any,
    degree: int,
    v: Any,
    records: Any,
    record_ints: Any,
    keys: Any,
    radii: Any,
    flags: Any,
) -> None:
    floats, indices = memory
    basis, rows, scratch = floats[:MATRIX], floats[MATRIX : 2 * MATRIX], floats[2 * MATRIX :]
    out = begin
    bad = splat(ZERO)  # stays 0 as long as every value is finite
    short = np.uint64(0)
    for start in range(begin, end, LANES):
        count = min(LANES, end - start)
        for lane in range(LANES):
            indices[lane] = min(start + lane, end - 1)
        mean, log_scale = gather_vectors(gaussians.means, indices), gather_vectors(gaussians.log_scales, indices)
        dc = gather_vectors(gaussians.sh_dc, indices)
        quaternion, _, squared_norm = gather_quaternions(gaussians.quaternions, indices)
        logit = gather(gaussians.logits, indices, 1, 0)
        finite = mean[0] * ZERO + mean[1] * ZERO + mean[2] * ZERO
        finite += log_scale[0] * ZERO + log_scale[1] * ZERO + log_scale[2] * ZERO
        finite += dc[0] * ZERO + dc[1] * ZERO + dc[2] * ZERO
        bad += finite + squared_norm * ZERO + logit * ZERO
        short |= mask_bits(squared_norm < MIN_QUATERNION_NORM * MIN_QUATERNION_NORM)

        offset = from_camera(mean, v)
        x, y, z = to_view(offset, v)
        inverse_z = ONE / z
        column = x * inverse_z * v.fx + v.pixel_cx
        row = y * inverse_z * v.fy + v.pixel_cy
        visible = (z > NEAR) & (absolute(column) < MAX_CENTER) & (absolute(row) < MAX_CENTER)
        if mask_bits(visible) == 0:
            for i in range(start, start + count):
                radii[i] = 0
            continue
        axis_x, axis_y, _, _ = image_axes(x * inverse_z, y * inverse_z, inverse_z, v)
        scales = (exponential(log_scale[0]), exponential(log_scale[1]), exponential(log_scale[2]))
        matrix = rotation_matrix(quaternion[0], quaternion[1], quaternion[2], quaternion[3])
        m0, m1 = scaled(times(axis_x, matrix), scales), scaled(times(axis_y, matrix), scales)
        visible = visible & (dot(m0, m0) + dot(m1, m1) < MAX_VARIANCE)
        xx, xy, yy, a = spread(m0, m1)
        half = (xx - yy) * HALF
        # middle^2 - det as a sum of squares
        largest = (xx + yy) * HALF + square_root(maximum(half * half + xy * xy, EIGENVALUE_FLOOR))
        radius = minimum(ceil(square_root(largest) * SIGMA_EXTENT), MAX_RADIUS)
        first_x, past_x = _tile_range(column - radius, column + radius, v.tiles_x)
        first_y, past_y = _tile_range(row - radius, row + radius, v.tiles_y)
        visible = visible & (first_x < past_x) & (first_y < past_y)
        store(scratch, 0, select(visible, radius, ZERO))
        for lane in range(count):
            radii[start + lane] = np.int32(scratch[lane])

        # Of the tiles of the 3 sigma square, those that the contour alpha = 1/255 can touch.
        opacity = ONE / (exponential(-logit) + ONE)
        log2_opacity = log2(maximum(opacity, ALPHA_MIN))
        reach = (log2_opacity - LOG2_ALPHA_MIN) * (2 / LOG2_E)  # squared Mahalanobis distance of the contour
        reach = maximum(reach, ZERO)
        half_x = square_root(reach * xx) * (1 + CONTOUR_MARGIN) + CONTOUR_MARGIN
        half_y = square_root(reach * yy) * (1 + CONTOUR_MARGIN) + CONTOUR_MARGIN
        inner_x, outer_x = _tile_range(ceil(column - half_x), floor(column + half_x) + ONE, v.tiles_x)
        inner_y, outer_y = _tile_range(ceil(row - half_y), floor(row + half_y) + ONE, v.tiles_y)
        first_x, past_x = maximum(first_x, inner_x), minimum(past_x, outer_x)
        first_y, past_y = maximum(first_y, inner_y), minimum(past_y, outer_y)
        seen = visible & (opacity > ALPHA_MIN) & (first_x < past_x) & (first_y < past_y)
        todo = mask_bits(seen) & ((np.uint64(1) << np.uint64(count)) - np.uint64(1))
        if todo == 0:
            continue

        red, green, blue = dc[0] * F0 + HALF, dc[1] * F0 + HALF, dc[2] * F0 + HALF
        if degree > 0:
            to, _ = normalized(offset)
            fill_basis(degree, to[0], to[1], to[2], basis)
            left = todo
            while left != 0:
                lane = lowest_bit(left)
                left &= left - np.uint64(1)
                own = load(basis, lane * np.uint64(LANES))
                by_red, by_green, by_blue = by_channel(load_rest(gaussians.sh_rest, (start + np.int64(lane)) * REST))
                store(rows, lane * np.uint64(LANES), own * by_red)
                store(scratch, lane * np.uint64(LANES), own * by_green)
                store(scratch, MATRIX + lane * np.uint64(LANES), own * by_blue)
            red += _row_sums(rows, 0)
            green += _row_sums(scratch, 0)
            blue += _row_sums(scratch, MATRIX)
        bad += select(seen, (red + green + blue) * ZERO, ZERO)
        clamped = select(red < ZERO, splat(ONE), ZERO)
        clamped += select(green < ZERO, splat(TWO), ZERO) + select(blue < ZERO, splat(FOUR), ZERO)

        store(rows, at.MEAN_X * LANES, column)
        store(rows, at.MEAN_Y * LANES, row)
        store(rows, at.SHEAR * LANES, -xy / yy)
        store(rows, at.CURVE_T * LANES, a * (-0.5 * LOG2_E))
        store(rows, at.CURVE_Y * LANES, (-0.5 * LOG2_E) / yy)
        store(rows, at.LOG2_OPACITY * LANES, log2_opacity)
        store(rows, at.RED * LANES, maximum(ZERO, red))  # NaN stays
        store(rows, at.GREEN * LANES, maximum(ZERO, green))
        store(rows, at.BLUE * LANES, maximum(ZERO, blue))
        store(rows, at.SLOPE * LANES, xy / xx)
        store(rows, at.RIGHTMOST_Y * LANES, xy * square_root(reach / xx))
        store(rows, at.DEPTH * LANES, z)
        store(rows, at.TILES_X * LANES, as_span(first_x, past_x))
        store(rows, at.TILES_Y * LANES, as_span(first_y, past_y))
        store(rows, at.INDEX * LANES, index_bits(start))
        store(rows, at.CLAMPED * LANES, as_integers(clamped))
        transpose(rows, 0)
        while todo != 0:
            lane = lowest_bit(todo)
            todo &= todo - np.uint64(1)
            store(records, out * at.RECORD, load(rows, lane * np.uint64(LANES)))
            # The bits of a positive float32 sort like its value; equal depths in the order of the index.
            keys[out] = (np.uint64(record_ints[out * at.RECORD + at.DEPTH]) << np.uint64(32)) | np.uint64(out)
            out += 1
    flags[VISIBLE] = out - begin
    sound = mask_bits(absolute(bad) <= ZERO)  # false for NaN
    flags[BAD_VALUE] = 0 if short == 0 and sound == ALL_LANES else 1


@inlined
def _row_sums(array: Any, place: int) -> Any:
    """The sums of the 16 rows of the 16x16 numbers at ``array[place:]``, row k in lane k."""
    transpose(array, place)
    total = load(array, place)
    for k in range(1, LANES):
        total += load(array, place + k * LANES)
    return total
