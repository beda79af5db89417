"""Projection of Gaussians to records, and its gradients, derived by hand; 16 Gaussians at a time.

A shard has the Gaussians ``begin`` to ``end``. Its visible Gaussians become the records ``begin``,
``begin + 1``, …, in the order of their indices.
"""

import math

import numpy as np

from gsbench.raster.base import CONSTANTS
from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.geometry import (
    F0,
    LOG2_E,
    MATRIX,
    direction_gradient,
    dot,
    exponential,
    fill_basis,
    from_camera,
    gather_quaternions,
    gather_vectors,
    image_axes,
    image_rows,
    normalized,
    rotation_matrix,
    scaled,
    spread,
    times,
    to_view,
)
from gsbench.raster.cpu.shuffle import (
    REST,
    as_integers,
    as_span,
    by_channel,
    index_bits,
    load_rest,
    outer_rest,
    store_rest,
    transpose,
)
from gsbench.raster.cpu.simd import (
    LANES,
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
    prefetch,
    scatter,
    select,
    splat,
    square_root,
    store,
)
from gsbench.raster.staged import MIN_QUATERNION_NORM
from gsbench.system.jit import inlined, kernel

NEAR, SIGMA_EXTENT, EIGENVALUE_FLOOR = (
    CONSTANTS.near,
    CONSTANTS.sigma_extent,
    CONSTANTS.eigenvalue_floor,
)
ALPHA_MIN, LOG2_ALPHA_MIN = CONSTANTS.alpha_min, math.log2(CONSTANTS.alpha_min)
MAX_RADIUS = 2.0**24  # px; keeps the radius of a huge Gaussian within int32
MAX_CENTER = 1e9  # px; so far outside the image, float32 cannot resolve a pixel
MAX_VARIANCE = 1e18  # px^2; the same for standard deviations; also keeps squares finite
# px, and relative: rounding must not lose a pixel of the contour alpha = 1/255
CONTOUR_MARGIN = 0.01
ZERO, HALF, ONE, TWO, FOUR = (np.float32(value) for value in (0, 0.5, 1, 2, 4))

AHEAD = 16  # records ahead that the backward pass prefetches
ALL_LANES = np.uint64((1 << LANES) - 1)
# entries of a shard's flags: number of visible Gaussians; 1 if a value is bad
VISIBLE, BAD_VALUE = 0, 1


@inlined
def _tile_range(low, high, tiles):
    """First and past-the-last tile for the pixels ``low`` to ``high`` - 1, within the grid."""
    first = floor(minimum(maximum(low * (1.0 / at.TILE), ZERO), np.float32(tiles)))
    past = floor(
        minimum(maximum((high + (at.TILE - 1)) * (1.0 / at.TILE), ZERO), np.float32(tiles))
    )
    return first, past


@kernel
def project_shards(
    memory, first, past, edges, gaussians, degree, v, records, record_ints, keys, radii, flags
):
    """Project the shards ``first`` to ``past``; shard s has the Gaussians from ``edges[s]`` to
    ``edges[s + 1]``.

    Fills ``records`` [N * 16], ``keys`` [N] (depth in the high word, record in the low word),
    ``radii`` [N] and ``flags`` [shards, 2].
    """
    for shard in range(first, past):
        begin, end = edges[shard], edges[shard + 1]
        _project(
            memory,
            begin,
            end,
            gaussians,
            degree,
            v,
            records,
            record_ints,
            keys,
            radii,
            flags[shard],
        )


@inlined
def _project(memory, begin, end, gaussians, degree, v, records, record_ints, keys, radii, flags):
    floats, indices = memory
    basis, rows, scratch = floats[:MATRIX], floats[MATRIX : 2 * MATRIX], floats[2 * MATRIX :]
    out = begin
    bad = splat(ZERO)  # sum of 0 * value: 0 if every value is finite, else NaN
    short = np.uint64(0)
    for start in range(begin, end, LANES):
        count = min(LANES, end - start)
        for lane in range(LANES):
            indices[lane] = min(start + lane, end - 1)
        mean, log_scale = (
            gather_vectors(gaussians.means, indices),
            gather_vectors(gaussians.log_scales, indices),
        )
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
        # The discriminant (trace / 2)^2 - det, written as a sum of squares.
        largest = (xx + yy) * HALF + square_root(maximum(half * half + xy * xy, EIGENVALUE_FLOOR))
        radius = minimum(ceil(square_root(largest) * SIGMA_EXTENT), MAX_RADIUS)
        first_x, past_x = _tile_range(column - radius, column + radius, v.tiles_x)
        first_y, past_y = _tile_range(row - radius, row + radius, v.tiles_y)
        visible = visible & (first_x < past_x) & (first_y < past_y)
        store(scratch, 0, select(visible, radius, ZERO))
        for lane in range(count):
            radii[start + lane] = np.int32(scratch[lane])

        # Of the tiles of the 3 sigma square, keep those that the contour alpha = 1/255 can touch.
        opacity = ONE / (exponential(-logit) + ONE)
        log2_opacity = log2(maximum(opacity, ALPHA_MIN))
        # squared Mahalanobis distance of the contour
        reach = (log2_opacity - LOG2_ALPHA_MIN) * (2 / LOG2_E)
        reach = maximum(reach, ZERO)
        half_x = square_root(reach * xx) * (1 + CONTOUR_MARGIN) + CONTOUR_MARGIN
        half_y = square_root(reach * yy) * (1 + CONTOUR_MARGIN) + CONTOUR_MARGIN
        inner_x, outer_x = _tile_range(
            ceil(column - half_x), floor(column + half_x) + ONE, v.tiles_x
        )
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
                by_red, by_green, by_blue = by_channel(
                    load_rest(gaussians.sh_rest, (start + np.int64(lane)) * REST)
                )
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
            # The bits of positive float32 numbers sort like the numbers. Equal depths sort by
            # index.
            keys[out] = (
                np.uint64(record_ints[out * at.RECORD + at.DEPTH]) << np.uint64(32)
            ) | np.uint64(out)
            out += 1
    flags[VISIBLE] = out - begin
    sound = mask_bits(absolute(bad) <= ZERO)  # False for NaN
    flags[BAD_VALUE] = 0 if short == 0 and sound == ALL_LANES else 1


@inlined
def _row_sums(array, place):
    """The sums of the 16 rows of the 16x16 matrix at ``array[place:]``; row k in lane k."""
    transpose(array, place)
    total = load(array, place)
    for k in range(1, LANES):
        total += load(array, place + k * LANES)
    return total


@inlined
def _first_shard(record_ints, base, v, tile_shard):
    """The shard of the first tile that the record at ``base`` can touch."""
    column, row = record_ints[base + at.TILES_X] & 0xFFFF, record_ints[base + at.TILES_Y] & 0xFFFF
    return tile_shard[row * v.tiles_x + column]


@inlined
def _take_rows(record, count, past, v, record_ints, tile_shard, rows, indices, sums):
    """Sum the gradient rows of ``count`` records over the shards of their tiles, and clear the
    rows.

    ``sums`` [16 * 16] gets one row per entry of a gradient row; ``indices`` [16] gets the
    Gaussians. If there are fewer than 16 records, the last one is repeated.
    """
    # Rows are cleared here, while they are in the cache; clearing them before the backward pass
    # would load them again.
    shard_rows = len(record_ints)  # a row is as long as a record
    for lane in range(count):
        ahead = min(record + lane + AHEAD, past - 1) * at.RECORD
        prefetch(rows, _first_shard(record_ints, ahead, v, tile_shard) * shard_rows + ahead)
        prefetch(record_ints, min(record + lane + 3 * AHEAD, past - 1) * at.RECORD)
    for lane in range(count):
        base = (record + lane) * at.RECORD
        indices[lane] = record_ints[base + at.INDEX]
        past_x, past_y = record_ints[base + at.TILES_X] >> 16, record_ints[base + at.TILES_Y] >> 16
        last = tile_shard[(past_y - 1) * v.tiles_x + past_x - 1]
        total = splat(ZERO)
        for shard in range(_first_shard(record_ints, base, v, tile_shard), last + 1):
            row = shard * shard_rows + base
            total += load(rows, row)
            store(rows, row, splat(ZERO))
        store(sums, lane * LANES, total)
    for lane in range(count, LANES):
        indices[lane] = indices[count - 1]
        store(sums, lane * LANES, load(sums, (count - 1) * LANES))
    transpose(sums, 0)


@kernel
def backproject_shards(
    memory,
    first,
    past,
    edges,
    visible,
    gaussians,
    degree,
    frame,
    rows,
    gradients,
    g_screen,
    g_absolute,
    g_splitting,
):
    """Write all ``gradients`` of the shards ``first`` to ``past``; shard s has the Gaussians from
    ``edges[s]`` to ``edges[s + 1]``, of which ``visible[s]`` have records.

    Reads and clears their ``rows`` [shards of tiles * N * 16]. ``g_absolute`` [N, 2] and
    ``g_splitting`` [N, 9] are empty if not requested.
    """
    for shard in range(first, past):
        begin, end = edges[shard], edges[shard + 1]
        outputs = gradients, g_screen, g_absolute, g_splitting
        _backproject(memory, begin, end, visible[shard], gaussians, degree, frame, rows, outputs)


@inlined
def _backproject(memory, begin, end, visible, gaussians, degree, frame, rows, outputs):
    gradients, g_screen, g_absolute, g_splitting = outputs
    v, record_ints, tile_shard = frame.camera, frame.record_ints, frame.tile_shard
    g_means, g_log_scales, g_quaternions = (
        gradients.means,
        gradients.log_scales,
        gradients.quaternions,
    )
    g_logits, g_sh_dc, g_sh_rest = gradients.logits, gradients.sh_dc, gradients.sh_rest
    unseen = begin  # the first Gaussian whose gradients are not written yet
    for record in range(begin, begin + visible + 1):
        past = end if record == begin + visible else record_ints[record * at.RECORD + at.INDEX]
        if past > unseen:
            _clear(g_means, unseen, past)
            _clear(g_log_scales, unseen, past)
            _clear(g_quaternions, unseen, past)
            _clear(g_logits, unseen, past)
            _clear(g_sh_dc, unseen, past)
            _clear(g_sh_rest, unseen, past)
            _clear(g_screen, unseen, past)
            if len(g_absolute) > 0:
                _clear(g_absolute, unseen, past)
            if len(g_splitting) > 0:
                _clear(g_splitting, unseen, past)
        unseen = past + 1
    floats, indices = memory
    sums, basis, pulled = floats[:MATRIX], floats[MATRIX : 2 * MATRIX], floats[2 * MATRIX :]
    colors = floats[3 * MATRIX :]
    for record in range(begin, begin + visible, LANES):
        count = min(LANES, begin + visible - record)
        _take_rows(record, count, begin + visible, v, record_ints, tile_shard, rows, indices, sums)
        mean, log_scale = (
            gather_vectors(gaussians.means, indices),
            gather_vectors(gaussians.log_scales, indices),
        )
        offset = from_camera(mean, v)

        # Colour. A channel below 0 was clamped and has no gradient.
        to, inverse_distance = normalized(offset)
        red, green, blue = _unclamped(record, count, record_ints, sums, colors)
        scatter(g_sh_dc, indices, 3, 0, red * F0)
        scatter(g_sh_dc, indices, 3, 1, green * F0)
        scatter(g_sh_dc, indices, 3, 2, blue * F0)
        if degree > 0:
            fill_basis(degree, to[0], to[1], to[2], basis)
            for lane in range(LANES):
                place = lane * LANES
                r, g, b = colors[lane], colors[LANES + lane], colors[2 * LANES + lane]
                by_red, by_green, by_blue = by_channel(
                    load_rest(gaussians.sh_rest, indices[lane] * REST)
                )
                store(pulled, place, by_red * r + by_green * g + by_blue * b)
                store_rest(g_sh_rest, indices[lane] * REST, outer_rest(load(basis, place), r, g, b))
        else:
            for lane in range(LANES):
                store_rest(g_sh_rest, indices[lane] * REST, (splat(ZERO), splat(ZERO), splat(ZERO)))
        through = direction_gradient(degree, to[0], to[1], to[2], pulled)

        # Repeat the geometry of the forward pass.
        quaternion, inverse_norm, _ = gather_quaternions(gaussians.quaternions, indices)
        qw, qx, qy, qz = quaternion
        matrix = rotation_matrix(qw, qx, qy, qz)
        x, y, z = to_view(offset, v)
        inverse_z = ONE / z
        axis_x, axis_y, slope_x, slope_y = image_axes(x * inverse_z, y * inverse_z, inverse_z, v)
        scales = (exponential(log_scale[0]), exponential(log_scale[1]), exponential(log_scale[2]))
        n0, n1 = times(axis_x, matrix), times(axis_y, matrix)
        m0, m1 = scaled(n0, scales), scaled(n1, scales)
        _, xy, yy, a = spread(m0, m1)
        e, shear = ONE / yy, -xy / yy  # power = -(a t^2 + e dy^2) / 2, t = dx + shear dy

        # Mean on the image: d power / d mean = (a t, shear a t + e dy).
        g_column = a * load(sums, at.SUM_H_T * LANES)
        g_row = shear * g_column + e * load(sums, at.SUM_H_Y * LANES)
        scatter(g_screen, indices, 2, 0, g_column * (0.5 * v.width))
        scatter(g_screen, indices, 2, 1, g_row * (0.5 * v.height))
        if len(g_absolute) > 0:
            absolute_t = a * load(sums, at.SUM_ABS_T * LANES)
            scatter(g_absolute, indices, 2, 0, absolute_t * (0.5 * v.width))
            absolute_y = load(sums, at.SUM_ABS_Y * LANES)
            scatter(g_absolute, indices, 2, 1, absolute_y * (0.5 * v.height))

        # Covariance: M = N S and N = A R. d loss / d M = U^T Q U M with Q = D G D, D = diag(a, e),
        # U = [[1, shear], [0, 1]] and G the second moments of h over (t, dy). For a needle the
        # first row of U M is small, so U N is computed first, before large numbers can cancel.
        q00 = a * a * load(sums, at.SUM_H_TT * LANES)
        q01 = a * e * load(sums, at.SUM_H_TY * LANES)
        q11 = e * e * load(sums, at.SUM_H_YY * LANES)
        if len(g_splitting) > 0:
            of_h = load(sums, at.SUM_H * LANES)
            free = image_rows(x * inverse_z, y * inverse_z, inverse_z, v)
            _scatter_splitting(
                g_splitting, indices, q00 - a * of_h, q01, q11 - e * of_h, shear, free
            )
        u0 = (n0[0] + shear * n1[0], n0[1] + shear * n1[1], n0[2] + shear * n1[2])
        g0 = (q00 * u0[0] + q01 * n1[0], q00 * u0[1] + q01 * n1[1], q00 * u0[2] + q01 * n1[2])
        g1 = (q01 * u0[0] + q11 * n1[0], q01 * u0[1] + q11 * n1[1], q01 * u0[2] + q11 * n1[2])
        variances = (scales[0] * scales[0], scales[1] * scales[1], scales[2] * scales[2])
        scatter(g_log_scales, indices, 3, 0, (u0[0] * g0[0] + n1[0] * g1[0]) * variances[0])
        scatter(g_log_scales, indices, 3, 1, (u0[1] * g0[1] + n1[1] * g1[1]) * variances[1])
        scatter(g_log_scales, indices, 3, 2, (u0[2] * g0[2] + n1[2] * g1[2]) * variances[2])

        # Rotation by small angles w about the Gaussian's own axes changes R S^2 R^T by a
        # commutator, so the gradient by w has differences of variances as factors. Computing these
        # differences first makes the gradient of a sphere exactly 0; otherwise rounding errors
        # would remain, which Adam scales to full steps. The quaternion changes by q (0, w) / 2.
        w_x = (u0[1] * g0[2] + n1[1] * g1[2]) * _difference(scales[1], scales[2])
        w_y = (u0[2] * g0[0] + n1[2] * g1[0]) * _difference(scales[2], scales[0])
        w_z = (u0[0] * g0[1] + n1[0] * g1[1]) * _difference(scales[0], scales[1])
        twice = inverse_norm + inverse_norm
        scatter(g_quaternions, indices, 4, 0, -(qx * w_x + qy * w_y + qz * w_z) * twice)
        scatter(g_quaternions, indices, 4, 1, (qw * w_x + qy * w_z - qz * w_y) * twice)
        scatter(g_quaternions, indices, 4, 2, (qw * w_y + qz * w_x - qx * w_z) * twice)
        scatter(g_quaternions, indices, 4, 3, (qw * w_z + qx * w_y - qy * w_x) * twice)

        # A = J W: d loss / d A, then by the entries of J, then by the position in view space.
        s0, s1 = scaled(g0, variances), scaled(g1, variances)
        s1 = (s1[0] + shear * s0[0], s1[1] + shear * s0[1], s1[2] + shear * s0[2])
        a0 = (dot(s0, matrix[0]), dot(s0, matrix[1]), dot(s0, matrix[2]))
        a1 = (dot(s1, matrix[0]), dot(s1, matrix[1]), dot(s1, matrix[2]))
        j00, j02 = (
            a0[0] * v.r00 + a0[1] * v.r01 + a0[2] * v.r02,
            a0[0] * v.r20 + a0[1] * v.r21 + a0[2] * v.r22,
        )
        j11, j12 = (
            a1[0] * v.r10 + a1[1] * v.r11 + a1[2] * v.r12,
            a1[0] * v.r20 + a1[1] * v.r21 + a1[2] * v.r22,
        )
        fx_z, fy_z = inverse_z * v.fx, inverse_z * v.fy
        free_x, free_y = x * inverse_z, y * inverse_z
        # The clamp of a slope passes the gradient only within the limits.
        g_slope_x = select((free_x >= v.slope_x_min) & (free_x <= v.slope_x_max), -fx_z * j02, ZERO)
        g_slope_y = select((free_y >= v.slope_y_min) & (free_y <= v.slope_y_max), -fy_z * j12, ZERO)
        view_x = g_column * fx_z + g_slope_x * inverse_z
        view_y = g_row * fy_z + g_slope_y * inverse_z
        through_focal = fx_z * (j00 - slope_x * j02) + fy_z * (j11 - slope_y * j12)
        view_z = -(through_focal * inverse_z + view_x * free_x + view_y * free_y)

        # Mean: its gradient through the image position, and through the view direction of the
        # colour.
        radial = dot(through, to)
        from_x = (through[0] - radial * to[0]) * inverse_distance
        from_y = (through[1] - radial * to[1]) * inverse_distance
        from_z = (through[2] - radial * to[2]) * inverse_distance
        scatter(g_means, indices, 3, 0, view_x * v.r00 + view_y * v.r10 + view_z * v.r20 + from_x)
        scatter(g_means, indices, 3, 1, view_x * v.r01 + view_y * v.r11 + view_z * v.r21 + from_y)
        scatter(g_means, indices, 3, 2, view_x * v.r02 + view_y * v.r12 + view_z * v.r22 + from_z)

        # d log(alpha) / d logit = 1 - opacity
        g_logit = load(sums, at.SUM_H * LANES) / (
            exponential(gather(gaussians.logits, indices, 1, 0)) + ONE
        )
        scatter(g_logits, indices, 1, 0, g_logit)


@inlined
def _scatter_splitting(g_splitting, indices, d00, d01, d11, shear, rows):
    """Write the splitting matrices F^T U^T (D G D - h D) U F. F = ``rows`` is the derivative of the
    projected mean; ``d00``, ``d01`` and ``d11`` are the entries of D G D - h D.

    The second derivative of alpha by the projected mean is alpha (u u^T - C), with u = C (dx, dy)
    and the conic C = U^T D U. Its sum with weights h / alpha is U^T (D G D - h D) U.
    """
    r0 = (
        rows[0][0] + shear * rows[1][0],
        rows[0][1] + shear * rows[1][1],
        rows[0][2] + shear * rows[1][2],
    )
    r1 = rows[1]
    s0 = (d00 * r0[0] + d01 * r1[0], d00 * r0[1] + d01 * r1[1], d00 * r0[2] + d01 * r1[2])
    s1 = (d01 * r0[0] + d11 * r1[0], d01 * r0[1] + d11 * r1[1], d01 * r0[2] + d11 * r1[2])
    xy, xz, yz = (
        r0[0] * s0[1] + r1[0] * s1[1],
        r0[0] * s0[2] + r1[0] * s1[2],
        r0[1] * s0[2] + r1[1] * s1[2],
    )
    scatter(g_splitting, indices, 9, 0, r0[0] * s0[0] + r1[0] * s1[0])
    scatter(g_splitting, indices, 9, 1, xy)
    scatter(g_splitting, indices, 9, 2, xz)
    scatter(g_splitting, indices, 9, 3, xy)
    scatter(g_splitting, indices, 9, 4, r0[1] * s0[1] + r1[1] * s1[1])
    scatter(g_splitting, indices, 9, 5, yz)
    scatter(g_splitting, indices, 9, 6, xz)
    scatter(g_splitting, indices, 9, 7, yz)
    scatter(g_splitting, indices, 9, 8, r0[2] * s0[2] + r1[2] * s1[2])


@inlined
def _difference(a, b):
    """a^2 - b^2 without cancellation, and without overflow of the squares."""
    return (a - b) * (a + b)


@inlined
def _unclamped(record, count, record_ints, sums, colors):
    """The gradients by red, green and blue, 0 if the channel was clamped; also written to
    ``colors`` [3 * 16]."""
    for lane in range(LANES):
        clamped = record_ints[(record + min(lane, count - 1)) * at.RECORD + at.CLAMPED]
        colors[lane] = ZERO if clamped & 1 else sums[at.SUM_RED * LANES + lane]
        colors[LANES + lane] = ZERO if clamped & 2 else sums[at.SUM_GREEN * LANES + lane]
        colors[2 * LANES + lane] = ZERO if clamped & 4 else sums[at.SUM_BLUE * LANES + lane]
    return load(colors, 0), load(colors, LANES), load(colors, 2 * LANES)


@inlined
def _clear(gradient, first, past):
    """Set the rows ``first`` to ``past`` of ``gradient`` [N, C] to 0."""
    for i in range(first, past):
        for c in range(gradient.shape[1]):
            gradient[i, c] = ZERO
