"""From Gaussians to records, and from the sums of compositing back to the gradients of the parameters.

Geometry is computed in float64, 8 Gaussians at a time: the 2D covariance of a needle loses too many digits in float32.
One call handles a shard: the Gaussians ``begin`` to ``end``. Its visible ones become the records ``begin``, ``begin +
1``, ... in the order of their index.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gsbench.gaussians.model import NUM_SH_REST
from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.harmonics import add_colors, pull_back_colors
from gsbench.raster.cpu.jit import inlined, kernel
from gsbench.raster.cpu.simd import (
    WIDE_LANES,
    absolute,
    ceil,
    exp2,
    floor,
    gather,
    load,
    log2,
    mask_bits,
    maximum,
    minimum,
    prefetch,
    select,
    splat,
    square_root,
    store,
    wide,
)
from gsbench.raster.validate import MIN_QUATERNION_NORM

LOG2_E = 1.0 / math.log(2.0)
MAX_RADIUS = 2.0**24  # px; keeps the radius of an absurdly large Gaussian inside int32
MAX_CENTER = 1e9  # px; a centre so far outside the image cannot be told apart in float32
MAX_LOG2_SCALE = (
    1000.0  # beyond, exp2 is undefined; such scales overflow in the determinant, and their Gaussian is culled
)
CONTOUR_MARGIN = 0.01  # px, and relative: rounding of the contour alpha = 1/255 must not lose a pixel
SH_TERMS = NUM_SH_REST + 1
LANE = np.arange(WIDE_LANES)
AHEAD = 16  # records that the prefetch runs ahead

VISIBLE, BAD_VALUE = 0, 1  # places of a shard's flags

# Rows of 8 numbers by which the vector part of ``project_shard`` hands over to the part for single Gaussians. Those of
# a record's own numbers have the place that they have in the record.
FIRST_X, PAST_X, FIRST_Y, PAST_Y, RADIUS, TO_X, TO_Y, TO_Z = range(at.RECORD, at.RECORD + 8)
SCRATCH_ROWS = at.RECORD + 8


@inlined
def _exponential(x: Any) -> Any:
    return exp2(maximum(minimum(x * LOG2_E, MAX_LOG2_SCALE), -MAX_LOG2_SCALE))


@inlined
def _matrix(w: Any, x: Any, y: Any, z: Any) -> Any:
    """The rows of the rotation matrix of a unit quaternion."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@inlined
def _to_view(mean: Any, v: Any) -> Any:
    x = mean[0] * v.r00 + mean[1] * v.r01 + mean[2] * v.r02 + v.tx
    y = mean[0] * v.r10 + mean[1] * v.r11 + mean[2] * v.r12 + v.ty
    z = mean[0] * v.r20 + mean[1] * v.r21 + mean[2] * v.r22 + v.tz
    return x, y, z


@inlined
def _image_axes(slope_x: Any, slope_y: Any, inverse_z: Any, v: Any) -> Any:
    """A = J W, the derivative of the pixel with respect to the world position, as two rows; the clamped slopes."""
    slope_x = minimum(maximum(slope_x, v.slope_x_min), v.slope_x_max)
    slope_y = minimum(maximum(slope_y, v.slope_y_min), v.slope_y_max)
    jx, jy = inverse_z * v.fx, inverse_z * v.fy
    first = (jx * (v.r00 - slope_x * v.r20), jx * (v.r01 - slope_x * v.r21), jx * (v.r02 - slope_x * v.r22))
    second = (jy * (v.r10 - slope_y * v.r20), jy * (v.r11 - slope_y * v.r21), jy * (v.r12 - slope_y * v.r22))
    return first, second, slope_x, slope_y


@inlined
def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def _times(row: Any, matrix: Any) -> Any:
    """``row`` [3] times ``matrix`` [3, 3]."""
    return (
        row[0] * matrix[0][0] + row[1] * matrix[1][0] + row[2] * matrix[2][0],
        row[0] * matrix[0][1] + row[1] * matrix[1][1] + row[2] * matrix[2][1],
        row[0] * matrix[0][2] + row[1] * matrix[1][2] + row[2] * matrix[2][2],
    )


@inlined
def _scaled(row: Any, scales: Any) -> Any:
    return row[0] * scales[0], row[1] * scales[1], row[2] * scales[2]


@inlined
def _gather3(array: Any, indices: Any) -> Any:
    return gather(array, indices, 3, 0), gather(array, indices, 3, 1), gather(array, indices, 3, 2)


@inlined
def _gather_quaternions(quaternions: Any, indices: Any) -> Any:
    """The unit quaternions, and the inverse norm and squared norm of what is stored."""
    w, x = gather(quaternions, indices, 4, 0), gather(quaternions, indices, 4, 1)
    y, z = gather(quaternions, indices, 4, 2), gather(quaternions, indices, 4, 3)
    squared = w * w + x * x + y * y + z * z
    inverse = 1 / square_root(squared)
    return (w * inverse, x * inverse, y * inverse, z * inverse), inverse, squared


@inlined
def _covariance(m0: Any, m1: Any, blur: Any) -> Any:
    """xx, xy, yy and the determinant of M M^T + blur I, for the rows of M.

    The determinant has no cancellation: det(M M^T) is the squared cross product of the rows.
    """
    xx, xy, yy = _dot(m0, m0), _dot(m0, m1), _dot(m1, m1)
    cross = (m0[1] * m1[2] - m0[2] * m1[1], m0[2] * m1[0] - m0[0] * m1[2], m0[0] * m1[1] - m0[1] * m1[0])
    return xx + blur, xy, yy + blur, _dot(cross, cross) + blur * (xx + yy + blur)


@inlined
def _tile_range(low: Any, high: Any, tiles: int) -> Any:
    """First and past-the-last tile for the pixels ``low`` to ``high`` - 1, within the grid."""
    first = floor(minimum(maximum(low * (1.0 / at.TILE), 0.0), np.float64(tiles)))
    past = floor(minimum(maximum((high + (at.TILE - 1)) * (1.0 / at.TILE), 0.0), np.float64(tiles)))
    return first, past


@inlined
def _direction(mean: Any, v: Any) -> Any:
    """From the camera centre to the mean, of length 1; the inverse distance."""
    dx, dy, dz = mean[0] - v.center_x, mean[1] - v.center_y, mean[2] - v.center_z
    inverse = 1 / square_root(dx * dx + dy * dy + dz * dz)
    return dx * inverse, dy * inverse, dz * inverse, inverse


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
        mean, log_scale, dc = _gather3(means, indices), _gather3(log_scales, indices), _gather3(sh_dc, indices)
        quaternion, _, squared_norm = _gather_quaternions(quaternions, indices)
        logit = gather(logits, indices, 1, 0)
        finite = mean[0] * 0 + mean[1] * 0 + mean[2] * 0 + log_scale[0] * 0 + log_scale[1] * 0 + log_scale[2] * 0
        bad += finite + squared_norm * 0 + logit * 0 + dc[0] * 0 + dc[1] * 0 + dc[2] * 0
        short |= mask_bits(squared_norm < MIN_QUATERNION_NORM * MIN_QUATERNION_NORM)

        x, y, z = _to_view(mean, v)
        inverse_z = 1 / z
        column = x * inverse_z * v.fx + v.pixel_cx
        row = y * inverse_z * v.fy + v.pixel_cy
        visible = (z > v.near) & (absolute(column) < MAX_CENTER) & (absolute(row) < MAX_CENTER)
        if mask_bits(visible) == 0:
            for i in range(start, min(start + WIDE_LANES, end)):
                radii[i] = 0
            continue
        axis_x, axis_y, _, _ = _image_axes(x * inverse_z, y * inverse_z, inverse_z, v)
        scales = (_exponential(log_scale[0]), _exponential(log_scale[1]), _exponential(log_scale[2]))
        matrix = _matrix(quaternion[0], quaternion[1], quaternion[2], quaternion[3])
        m0, m1 = _scaled(_times(axis_x, matrix), scales), _scaled(_times(axis_y, matrix), scales)
        xx, xy, yy, determinant = _covariance(m0, m1, v.blur)
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
        opacity = 1 / (_exponential(-logit) + 1)
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

        to_x, to_y, to_z, _ = _direction(mean, v)
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


@inlined
def _scatter(array: Any, indices: Any, offset: int, count: int, scratch: Any, values: Any) -> None:
    store(scratch, 0, values)
    for lane in range(count):
        array[indices[lane], offset] = scratch[lane]


@inlined
def _take_rows(
    record: int, count: int, past: int, v: Any, record_ints: Any, tile_shard: Any, rows: Any, indices: Any, total: Any
) -> None:
    """Sum the rows of ``count`` records over the shards of their tiles, into ``total`` [8 * 16]; clear the rows."""
    shard_rows = len(record_ints)  # a row is as long as a record
    for lane in range(count):
        ahead = min(record + lane + AHEAD, past - 1) * at.RECORD
        tiles_x, tiles_y = record_ints[ahead + at.TILES_X], record_ints[ahead + at.TILES_Y]
        shard = tile_shard[(tiles_y & 0xFFFF) * v.tiles_x + (tiles_x & 0xFFFF)]
        prefetch(rows, shard * shard_rows + ahead)
        prefetch(record_ints, min(record + lane + 3 * AHEAD, past - 1) * at.RECORD)
    for lane in range(WIDE_LANES):
        place = lane * at.ROW
        if lane >= count:
            indices[lane] = indices[count - 1]
            store(total, place, splat(0))
            continue
        base = (record + lane) * at.RECORD
        indices[lane] = record_ints[base + at.INDEX]
        tiles_x, tiles_y = record_ints[base + at.TILES_X], record_ints[base + at.TILES_Y]
        first = tile_shard[(tiles_y & 0xFFFF) * v.tiles_x + (tiles_x & 0xFFFF)]
        last = tile_shard[((tiles_y >> 16) - 1) * v.tiles_x + (tiles_x >> 16) - 1]
        sums = splat(0)
        for shard in range(first, last + 1):
            row = shard * shard_rows + base
            sums += load(rows, row)
            store(rows, row, splat(0))
        store(total, place, sums)


@kernel
def backproject_shard(
    memory: Any,
    begin: int,
    end: int,
    visible: int,
    means: Any,
    log_scales: Any,
    quaternions: Any,
    logits: Any,
    sh_rest: Any,
    degree: int,
    v: Any,
    record_ints: Any,
    tile_shard: Any,
    rows: Any,
    g_means: Any,
    g_log_scales: Any,
    g_quaternions: Any,
    g_logits: Any,
    g_sh_dc: Any,
    g_sh_rest: Any,
    g_screen: Any,
    g_absolute: Any,
    absolute_gradient: bool,
) -> None:
    """Write every gradient of the Gaussians ``begin`` to ``end``; reads and clears their ``rows`` [shards * N * 16]."""
    for gradient in (g_means, g_log_scales, g_quaternions, g_logits, g_sh_dc, g_sh_rest, g_screen):
        _clear_unseen(begin, end, visible, record_ints, gradient)
    if absolute_gradient:
        _clear_unseen(begin, end, visible, record_ints, g_absolute)
    floats, doubles, indices = memory
    basis, g_basis, total = floats[:SH_TERMS], floats[SH_TERMS : 2 * SH_TERMS], floats[2 * SH_TERMS :]
    scratch, toward, pulled = doubles[:WIDE_LANES], doubles[WIDE_LANES:], doubles[4 * WIDE_LANES :]
    for k in range(3 * WIDE_LANES):
        pulled[k] = 0
    for record in range(begin, begin + visible, WIDE_LANES):
        count = min(WIDE_LANES, begin + visible - record)
        _take_rows(record, count, begin + visible, v, record_ints, tile_shard, rows, indices, total)
        mean, log_scale = _gather3(means, indices), _gather3(log_scales, indices)

        # Colour: one Gaussian after the other.
        to_x, to_y, to_z, inverse_distance = _direction(mean, v)
        store(toward, 0, to_x)
        store(toward, WIDE_LANES, to_y)
        store(toward, 2 * WIDE_LANES, to_z)
        for lane in range(count):
            direction = (
                np.float32(toward[lane]),
                np.float32(toward[WIDE_LANES + lane]),
                np.float32(toward[2 * WIDE_LANES + lane]),
            )
            clamped = record_ints[(record + lane) * at.RECORD + at.CLAMPED]
            place = lane * at.ROW
            red = np.float32(0) if clamped & 1 else total[place + at.SUM_RED]
            green = np.float32(0) if clamped & 2 else total[place + at.SUM_GREEN]
            blue = np.float32(0) if clamped & 4 else total[place + at.SUM_BLUE]
            pull = pull_back_colors(
                degree, direction, (red, green, blue), sh_rest, indices[lane], basis, g_basis, g_sh_dc, g_sh_rest
            )
            pulled[lane], pulled[WIDE_LANES + lane], pulled[2 * WIDE_LANES + lane] = pull[0], pull[1], pull[2]

        # The forward geometry once more.
        quaternion, inverse_norm, _ = _gather_quaternions(quaternions, indices)
        qw, qx, qy, qz = quaternion
        matrix = _matrix(qw, qx, qy, qz)
        x, y, z = _to_view(mean, v)
        inverse_z = 1 / z
        axis_x, axis_y, slope_x, slope_y = _image_axes(x * inverse_z, y * inverse_z, inverse_z, v)
        scales = (_exponential(log_scale[0]), _exponential(log_scale[1]), _exponential(log_scale[2]))
        m0, m1 = _scaled(_times(axis_x, matrix), scales), _scaled(_times(axis_y, matrix), scales)
        _, xy, yy, determinant = _covariance(m0, m1, v.blur)
        a, e, shear = yy / determinant, 1 / yy, -xy / yy  # power = -(a t^2 + e dy^2) / 2, t = dx + shear dy

        # Mean on the image: d power / d mean = (a t, shear a t + e dy).
        g_column = a * gather(total, LANE, at.ROW, at.SUM_H_T)
        g_row = shear * g_column + e * gather(total, LANE, at.ROW, at.SUM_H_Y)
        _scatter(g_screen, indices, 0, count, scratch, g_column * (0.5 * v.width))
        _scatter(g_screen, indices, 1, count, scratch, g_row * (0.5 * v.height))
        if absolute_gradient:
            absolute_t = a * gather(total, LANE, at.ROW, at.SUM_ABS_T)
            _scatter(g_absolute, indices, 0, count, scratch, absolute_t * (0.5 * v.width))
            absolute_y = gather(total, LANE, at.ROW, at.SUM_ABS_Y)
            _scatter(g_absolute, indices, 1, count, scratch, absolute_y * (0.5 * v.height))

        # d loss / d M = U^T (D G D) (U M), with D = diag(a, e), U = [[1, shear], [0, 1]], G the second moments of h
        # over (t, dy).
        p00 = a * a * gather(total, LANE, at.ROW, at.SUM_H_TT)
        p01 = a * e * gather(total, LANE, at.ROW, at.SUM_H_TY)
        p11 = e * e * gather(total, LANE, at.ROW, at.SUM_H_YY)
        n0 = (m0[0] + shear * m1[0], m0[1] + shear * m1[1], m0[2] + shear * m1[2])
        g0 = (p00 * n0[0] + p01 * m1[0], p00 * n0[1] + p01 * m1[1], p00 * n0[2] + p01 * m1[2])
        g1 = (
            shear * g0[0] + p01 * n0[0] + p11 * m1[0],
            shear * g0[1] + p01 * n0[1] + p11 * m1[1],
            shear * g0[2] + p01 * n0[2] + p11 * m1[2],
        )

        # M = A R S: the scales, then R through B = A^T (d loss / d M) S.
        _scatter(g_log_scales, indices, 0, count, scratch, g0[0] * m0[0] + g1[0] * m1[0])
        _scatter(g_log_scales, indices, 1, count, scratch, g0[1] * m0[1] + g1[1] * m1[1])
        _scatter(g_log_scales, indices, 2, count, scratch, g0[2] * m0[2] + g1[2] * m1[2])
        s0, s1 = _scaled(g0, scales), _scaled(g1, scales)
        b00, b11 = axis_x[0] * s0[0] + axis_y[0] * s1[0], axis_x[1] * s0[1] + axis_y[1] * s1[1]
        b22 = axis_x[2] * s0[2] + axis_y[2] * s1[2]
        b01, b10 = axis_x[0] * s0[1] + axis_y[0] * s1[1], axis_x[1] * s0[0] + axis_y[1] * s1[0]
        b02, b20 = axis_x[0] * s0[2] + axis_y[0] * s1[2], axis_x[2] * s0[0] + axis_y[2] * s1[0]
        b12, b21 = axis_x[1] * s0[2] + axis_y[1] * s1[2], axis_x[2] * s0[1] + axis_y[2] * s1[1]
        g_w = 2 * (qx * (b21 - b12) + qy * (b02 - b20) + qz * (b10 - b01))
        g_x = 2 * (qw * (b21 - b12) + qy * (b01 + b10) + qz * (b02 + b20) - 2 * qx * (b11 + b22))
        g_y = 2 * (qw * (b02 - b20) + qx * (b01 + b10) + qz * (b12 + b21) - 2 * qy * (b00 + b22))
        g_z = 2 * (qw * (b10 - b01) + qx * (b02 + b20) + qy * (b12 + b21) - 2 * qz * (b00 + b11))
        along = g_w * qw + g_x * qx + g_y * qy + g_z * qz
        _scatter(g_quaternions, indices, 0, count, scratch, (g_w - along * qw) * inverse_norm)
        _scatter(g_quaternions, indices, 1, count, scratch, (g_x - along * qx) * inverse_norm)
        _scatter(g_quaternions, indices, 2, count, scratch, (g_y - along * qy) * inverse_norm)
        _scatter(g_quaternions, indices, 3, count, scratch, (g_z - along * qz) * inverse_norm)

        # A = J W: d loss / d A, then J's entries, then the position in the view.
        a0 = (_dot(s0, matrix[0]), _dot(s0, matrix[1]), _dot(s0, matrix[2]))
        a1 = (_dot(s1, matrix[0]), _dot(s1, matrix[1]), _dot(s1, matrix[2]))
        j00, j02 = a0[0] * v.r00 + a0[1] * v.r01 + a0[2] * v.r02, a0[0] * v.r20 + a0[1] * v.r21 + a0[2] * v.r22
        j11, j12 = a1[0] * v.r10 + a1[1] * v.r11 + a1[2] * v.r12, a1[0] * v.r20 + a1[1] * v.r21 + a1[2] * v.r22
        fx_z, fy_z = inverse_z * v.fx, inverse_z * v.fy
        free_x, free_y = x * inverse_z, y * inverse_z
        # The clamp of the slope passes the gradient only within its limits.
        g_slope_x = select((free_x >= v.slope_x_min) & (free_x <= v.slope_x_max), -fx_z * j02, 0.0)
        g_slope_y = select((free_y >= v.slope_y_min) & (free_y <= v.slope_y_max), -fy_z * j12, 0.0)
        view_x = g_column * fx_z + g_slope_x * inverse_z
        view_y = g_row * fy_z + g_slope_y * inverse_z
        through_focal = fx_z * (j00 - slope_x * j02) + fy_z * (j11 - slope_y * j12)
        view_z = -(through_focal * inverse_z + view_x * free_x + view_y * free_y)

        # Position: through the image and through the direction of the colour.
        h_x, h_y, h_z = load(pulled, 0), load(pulled, WIDE_LANES), load(pulled, 2 * WIDE_LANES)
        radial = h_x * to_x + h_y * to_y + h_z * to_z
        from_x = (h_x - radial * to_x) * inverse_distance
        from_y = (h_y - radial * to_y) * inverse_distance
        from_z = (h_z - radial * to_z) * inverse_distance
        _scatter(g_means, indices, 0, count, scratch, view_x * v.r00 + view_y * v.r10 + view_z * v.r20 + from_x)
        _scatter(g_means, indices, 1, count, scratch, view_x * v.r01 + view_y * v.r11 + view_z * v.r21 + from_y)
        _scatter(g_means, indices, 2, count, scratch, view_x * v.r02 + view_y * v.r12 + view_z * v.r22 + from_z)

        # d log(alpha) / d logit = 1 - opacity
        g_logit = gather(total, LANE, at.ROW, at.SUM_H) / (_exponential(gather(logits, indices, 1, 0)) + 1)
        _scatter(g_logits, indices, 0, count, scratch, g_logit)


@inlined
def _clear_unseen(begin: int, end: int, visible: int, record_ints: Any, gradient: Any) -> None:
    """Zero the rows of ``gradient`` [N, C] of the Gaussians without a record."""
    i = begin
    for record in range(begin, begin + visible + 1):
        past = end if record == begin + visible else record_ints[record * at.RECORD + at.INDEX]
        for j in range(i, past):
            for c in range(gradient.shape[1]):
                gradient[j, c] = 0
        i = past + 1
