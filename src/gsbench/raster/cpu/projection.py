"""Projection of Gaussians to records.

One call handles a shard: the Gaussians ``begin`` to ``end``. Its visible ones become the records ``begin``,
``begin + 1``, ... in the order of their index.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.geometry import (
    LOG2_E,
    covariance,
    direction_from_camera,
    exponential,
    gather_quaternions,
    gather_vectors,
    image_axes,
    rotation_matrix,
    scaled,
    times,
    to_view,
)
from gsbench.raster.cpu.harmonics import SH_TERMS, add_colors
from gsbench.raster.cpu.jit import inlined, kernel
from gsbench.raster.cpu.simd import (
    WIDE_LANES,
    absolute,
    ceil,
    floor,
    gather,
    log2,
    mask_bits,
    maximum,
    minimum,
    select,
    square_root,
    store,
    wide,
)
from gsbench.raster.validate import MIN_QUATERNION_NORM

MAX_RADIUS = 2.0**24  # px; keeps the radius of an absurdly large Gaussian inside int32
MAX_CENTER = 1e9  # px; a centre so far outside the image cannot be told apart in float32
CONTOUR_MARGIN = 0.01  # px, and relative: rounding of the contour alpha = 1/255 must not lose a pixel

VISIBLE, BAD_VALUE = 0, 1  # places of a shard's flags

# Rows of 8 numbers by which the vector part of ``project_shard`` hands over to the part for single Gaussians. Numbers
# of a record have the place there that they have in the record.
FIRST_X, PAST_X, FIRST_Y, PAST_Y, RADIUS, TO_X, TO_Y, TO_Z = range(at.RECORD, at.RECORD + 8)


@inlined
def _tile_range(low: Any, high: Any, tiles: int) -> Any:
    """First and past-the-last tile for the pixels ``low`` to ``high`` - 1, within the grid."""
    first = floor(minimum(maximum(low * (1.0 / at.TILE), 0.0), np.float64(tiles)))
    past = floor(minimum(maximum((high + (at.TILE - 1)) * (1.0 / at.TILE), 0.0), np.float64(tiles)))
    return first, past


@kernel
def project_shard(
    memory: Any,
    begin: int,
    end: int,
    means: Any,
    log_scales: Any,
    quaternions: Any,
    logits: Any,
    sh_dc: Any,
    sh_rest: Any,
    degree: int,
    v: Any,
    records: Any,
    record_ints: Any,
    keys: Any,
    radii: Any,
    flags: Any,
) -> None:
    """Fill ``records`` [N * 16], ``keys`` [N] (depth, then record), ``radii`` [N], and the two ``flags``."""
    floats, scratch, indices = memory
    basis, rgb = floats[:SH_TERMS], floats[SH_TERMS:]
    out = begin
    bad = wide(0)  # stays 0 as long as every value is finite
    short = np.uint64(0)
    for start in range(begin, end, WIDE_LANES):
        for lane in range(WIDE_LANES):
            indices[lane] = min(start + lane, end - 1)
        mean, log_scale, dc = (
            gather_vectors(means, indices),
            gather_vectors(log_scales, indices),
            gather_vectors(sh_dc, indices),
        )
        quaternion, _, squared_norm = gather_quaternions(quaternions, indices)
        logit = gather(logits, indices, 1, 0)
        finite = mean[0] * 0 + mean[1] * 0 + mean[2] * 0 + log_scale[0] * 0 + log_scale[1] * 0 + log_scale[2] * 0
        bad += finite + squared_norm * 0 + logit * 0 + dc[0] * 0 + dc[1] * 0 + dc[2] * 0
        short |= mask_bits(squared_norm < MIN_QUATERNION_NORM * MIN_QUATERNION_NORM)

        x, y, z = to_view(mean, v)
        inverse_z = 1 / z
        column = x * inverse_z * v.fx + v.pixel_cx
        row = y * inverse_z * v.fy + v.pixel_cy
        visible = (z > v.near) & (absolute(column) < MAX_CENTER) & (absolute(row) < MAX_CENTER)
        if mask_bits(visible) == 0:
            for i in range(start, min(start + WIDE_LANES, end)):
                radii[i] = 0
            continue
        axis_x, axis_y, _, _ = image_axes(x * inverse_z, y * inverse_z, inverse_z, v)
        scales = (exponential(log_scale[0]), exponential(log_scale[1]), exponential(log_scale[2]))
        matrix = rotation_matrix(quaternion[0], quaternion[1], quaternion[2], quaternion[3])
        m0, m1 = scaled(times(axis_x, matrix), scales), scaled(times(axis_y, matrix), scales)
        xx, xy, yy, determinant = covariance(m0, m1, v.blur)
        half = (xx - yy) * 0.5
        # middle^2 - det as a sum of squares
        largest = (xx + yy) * 0.5 + square_root(maximum(half * half + xy * xy, v.eigenvalue_floor))
        radius = minimum(ceil(square_root(largest) * v.sigma_extent), MAX_RADIUS)
        first_x, past_x = _tile_range(column - radius, column + radius, v.tiles_x)
        first_y, past_y = _tile_range(row - radius, row + radius, v.tiles_y)
        visible = visible & (determinant < np.inf) & (first_x < past_x) & (first_y < past_y)
        store(scratch, RADIUS * WIDE_LANES, select(visible, radius, 0.0))
        for lane in range(min(WIDE_LANES, end - start)):
            radii[start + lane] = np.int32(scratch[RADIUS * WIDE_LANES + lane])

        # Of the tiles of the 3 sigma square, those that the contour alpha = 1/255 can touch.
        opacity = 1 / (exponential(-logit) + 1)
        seen = visible & (opacity > v.alpha_min)
        log2_opacity = log2(maximum(opacity, v.alpha_min))
        reach = (log2_opacity - v.log2_alpha_min) * (2 / LOG2_E)  # squared Mahalanobis distance of the contour
        half_x = square_root(reach * xx) * (1 + CONTOUR_MARGIN) + CONTOUR_MARGIN
        half_y = square_root(reach * yy) * (1 + CONTOUR_MARGIN) + CONTOUR_MARGIN
        inner_x, outer_x = _tile_range(ceil(column - half_x), floor(column + half_x) + 1, v.tiles_x)
        inner_y, outer_y = _tile_range(ceil(row - half_y), floor(row + half_y) + 1, v.tiles_y)
        first_x, past_x = maximum(first_x, inner_x), minimum(past_x, outer_x)
        first_y, past_y = maximum(first_y, inner_y), minimum(past_y, outer_y)
        todo = mask_bits(seen & (first_x < past_x) & (first_y < past_y))
        if end - start < WIDE_LANES:
            todo &= (np.uint64(1) << np.uint64(end - start)) - np.uint64(1)
        if todo == 0:
            continue

        to_x, to_y, to_z, _ = direction_from_camera(mean, v)
        store(scratch, at.MEAN_X * WIDE_LANES, column)
        store(scratch, at.MEAN_Y * WIDE_LANES, row)
        store(scratch, at.SHEAR * WIDE_LANES, -xy / yy)
        store(scratch, at.CURVE_T * WIDE_LANES, yy / determinant * (-0.5 * LOG2_E))
        store(scratch, at.CURVE_Y * WIDE_LANES, (-0.5 * LOG2_E) / yy)
        store(scratch, at.LOG2_OPACITY * WIDE_LANES, log2_opacity)
        store(scratch, at.SLOPE * WIDE_LANES, xy / xx)
        store(scratch, at.RIGHTMOST_Y * WIDE_LANES, xy * square_root(reach / xx))
        store(scratch, at.DEPTH * WIDE_LANES, z)
        store(scratch, FIRST_X * WIDE_LANES, first_x)
        store(scratch, PAST_X * WIDE_LANES, past_x)
        store(scratch, FIRST_Y * WIDE_LANES, first_y)
        store(scratch, PAST_Y * WIDE_LANES, past_y)
        store(scratch, TO_X * WIDE_LANES, to_x)
        store(scratch, TO_Y * WIDE_LANES, to_y)
        store(scratch, TO_Z * WIDE_LANES, to_z)
        for lane in range(WIDE_LANES):
            if not todo >> np.uint64(lane) & np.uint64(1):
                continue
            i, base = start + lane, out * at.RECORD
            direction = (
                np.float32(scratch[TO_X * WIDE_LANES + lane]),
                np.float32(scratch[TO_Y * WIDE_LANES + lane]),
                np.float32(scratch[TO_Z * WIDE_LANES + lane]),
            )
            for place in range(at.DEPTH + 1):
                records[base + place] = scratch[place * WIDE_LANES + lane]
            clamped = add_colors(degree, direction, sh_dc, sh_rest, i, basis, rgb)
            records[base + at.RED], records[base + at.GREEN], records[base + at.BLUE] = rgb[0], rgb[1], rgb[2]
            bad += (rgb[0] + rgb[1] + rgb[2]) * np.float32(0)
            record_ints[base + at.TILES_X] = _packed(scratch, FIRST_X, PAST_X, lane)
            record_ints[base + at.TILES_Y] = _packed(scratch, FIRST_Y, PAST_Y, lane)
            record_ints[base + at.INDEX] = i
            record_ints[base + at.CLAMPED] = clamped
            # The bits of a positive float32 sort like its value; equal depths in the order of the index.
            keys[out] = (np.uint64(record_ints[base + at.DEPTH]) << np.uint64(32)) | np.uint64(out)
            out += 1
    flags[VISIBLE] = out - begin
    store(scratch, 0, bad)
    flags[BAD_VALUE] = 1 if short != 0 else 0
    for lane in range(WIDE_LANES):
        if scratch[lane] != 0:
            flags[BAD_VALUE] = 1


@inlined
def _packed(scratch: Any, first: int, past: int, lane: int) -> Any:
    return np.int32(scratch[first * WIDE_LANES + lane]) + (np.int32(scratch[past * WIDE_LANES + lane]) << 16)
