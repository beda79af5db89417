"""Gradients of the parameters from the gradient sums of compositing, derived by hand, 8 records at a time."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.geometry import (
    covariance,
    direction_from_camera,
    dot,
    exponential,
    gather_quaternions,
    gather_vectors,
    image_axes,
    rotation_matrix,
    scaled,
    times,
    to_view,
)
from gsbench.raster.cpu.harmonics import SH_TERMS, pull_back_colors
from gsbench.raster.cpu.jit import inlined, kernel
from gsbench.raster.cpu.simd import WIDE_LANES, gather, load, prefetch, select, splat, store

LANE = np.arange(WIDE_LANES)
AHEAD = 16  # records that the prefetch runs ahead


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
        mean, log_scale = gather_vectors(means, indices), gather_vectors(log_scales, indices)

        # Colour: one Gaussian after the other.
        to_x, to_y, to_z, inverse_distance = direction_from_camera(mean, v)
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
        quaternion, inverse_norm, _ = gather_quaternions(quaternions, indices)
        qw, qx, qy, qz = quaternion
        matrix = rotation_matrix(qw, qx, qy, qz)
        x, y, z = to_view(mean, v)
        inverse_z = 1 / z
        axis_x, axis_y, slope_x, slope_y = image_axes(x * inverse_z, y * inverse_z, inverse_z, v)
        scales = (exponential(log_scale[0]), exponential(log_scale[1]), exponential(log_scale[2]))
        m0, m1 = scaled(times(axis_x, matrix), scales), scaled(times(axis_y, matrix), scales)
        _, xy, yy, determinant = covariance(m0, m1, v.blur)
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
        s0, s1 = scaled(g0, scales), scaled(g1, scales)
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
        a0 = (dot(s0, matrix[0]), dot(s0, matrix[1]), dot(s0, matrix[2]))
        a1 = (dot(s1, matrix[0]), dot(s1, matrix[1]), dot(s1, matrix[2]))
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
        g_logit = gather(total, LANE, at.ROW, at.SUM_H) / (exponential(gather(logits, indices, 1, 0)) + 1)
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
