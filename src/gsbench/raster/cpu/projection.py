"""Projection of Gaussians to records, and its gradients, derived by hand; 16 Gaussians at a time.

A shard has the Gaussians ``begin`` to ``end``. Its visible Gaussians become the records ``begin``,
``begin + 1``, …, in the order of their indices.
"""

import math

import numpy as np

from gsbench.raster.base import CONSTANTS
from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.adam import step_all
from gsbench.raster.cpu.binning import shards_of
from gsbench.raster.cpu.geometry import (
    F0,
    LOG2_E,
    MATRIX,
    contour_range,
    covariance_gradients,
    direction_gradient,
    dot,
    exponential,
    exponentials,
    fill_basis,
    from_camera,
    gather_quaternions,
    image_axes,
    image_rows,
    normalized,
    plus,
    position_gradient,
    quaternion_gradient,
    radius_of,
    record_entries,
    scaled,
    splitting_entries,
    spread,
    stretched,
    through,
    tile_range,
    view_axes,
)
from gsbench.raster.cpu.shuffle import (
    REST,
    as_integers,
    as_span,
    by_channel,
    index_bits,
    load_rest,
    outer_rest,
    store_columns,
    store_rest,
    transpose,
)
from gsbench.raster.cpu.simd import (
    LANES,
    absolute,
    gather_numbers,
    gather_vectors,
    load,
    log2,
    lowest_bit,
    mask_bits,
    mask_from_bits,
    maximum,
    minimum,
    prefetch_far,
    scatter,
    select,
    splat,
    square_root,
    store,
)
from gsbench.raster.staged import MIN_QUATERNION_NORM
from gsbench.system.jit import inlined, kernel

NEAR = CONSTANTS.near
ALPHA_MIN, LOG2_ALPHA_MIN = CONSTANTS.alpha_min, math.log2(CONSTANTS.alpha_min)
MAX_CENTER, MAX_VARIANCE = CONSTANTS.max_center, CONSTANTS.max_variance
ZERO, HALF, ONE, TWO, FOUR = (np.float32(value) for value in (0, 0.5, 1, 2, 4))
TWO_LN_2 = np.float32(2 * math.log(2))

FAR = 64  # Gaussians ahead whose harmonics are prefetched
ALL_LANES = np.uint64((1 << LANES) - 1)
# entries of a shard's flags: number of visible Gaussians; 1 if a value is bad
VISIBLE, BAD_VALUE = 0, 1


@kernel
def project_shards(
    first, past, memory, edges, gaussians, degree, v, records, record_ints, keys, radii, flags
):
    """Project the shards ``first`` to ``past``.

    Shard s has the Gaussians from ``edges[s]`` to before ``edges[s + 1]``. Fills ``records``
    [N * 16], ``keys`` [N] (depth in the high word, record in the low word), ``radii`` [N] and
    ``flags`` [shards, 2].
    """
    for shard in range(first, past):
        begin, end = edges[shard], edges[shard + 1]
        outputs = records, record_ints, keys, radii, flags[shard]
        _project(memory[0][first], memory[1][first], begin, end, gaussians, degree, v, outputs)


@inlined
def _project(floats, indices, begin, end, gaussians, degree, v, outputs):
    records, record_ints, keys, radii, flags = outputs
    rows, scratch = floats[MATRIX : 2 * MATRIX], floats[2 * MATRIX :]
    out = begin
    bad = splat(ZERO)  # sum of 0 * value: 0 if every value is finite, else NaN
    short = np.uint64(0)
    for start in range(begin, end, LANES):
        count = min(LANES, end - start)
        # The last vector of a shard repeats its last Gaussian; those lanes are never stored.
        for lane in range(LANES):
            indices[lane] = min(start + lane, end - 1)
        if degree > 0:
            _prefetch_harmonics(gaussians.sh_rest, start, start + LANES)
        mean = gather_vectors(gaussians.means, indices)
        log_scale = gather_vectors(gaussians.log_scales, indices)
        dc = gather_vectors(gaussians.sh_dc, indices)
        quaternion, _, squared_norm = gather_quaternions(gaussians.quaternions, indices)
        (logit,) = gather_numbers(gaussians.logits, indices)
        finite = _zero_if_finite(mean)
        finite += _zero_if_finite(log_scale)
        finite += _zero_if_finite(dc)
        bad += finite + squared_norm * ZERO + logit * ZERO
        short |= mask_bits(squared_norm < MIN_QUATERNION_NORM * MIN_QUATERNION_NORM)

        # The mean on the image, px: (fx x / z + cx - 1/2, fy y / z + cy - 1/2).
        offset = from_camera(mean, v)
        x, y, z = through(view_axes(v), offset)
        inverse_z = ONE / z
        free_x, free_y = x * inverse_z, y * inverse_z
        column, row = free_x * v.fx + v.pixel_cx, free_y * v.fy + v.pixel_cy
        visible = (z > NEAR) & (absolute(column) < MAX_CENTER) & (absolute(row) < MAX_CENTER)
        if mask_bits(visible) == 0:
            for i in range(start, start + count):
                radii[i] = 0
            continue

        _, n0, n1 = image_axes(free_x, free_y, inverse_z, quaternion, v)
        scales = exponentials(log_scale)
        m0, m1 = scaled(n0, scales), scaled(n1, scales)
        visible = visible & (dot(m0, m0) + dot(m1, m1) < MAX_VARIANCE)
        xx, xy, yy, a = spread(m0, m1)
        radius = radius_of(xx, xy, yy)
        first_x, past_x = tile_range(column - radius, column + radius, v.tiles_x, at.TILE)
        first_y, past_y = tile_range(row - radius, row + radius, v.tiles_y, at.TILE)
        visible = visible & (first_x < past_x) & (first_y < past_y)
        store(scratch, 0, select(visible, radius, ZERO))
        for lane in range(count):
            radii[start + lane] = np.int32(scratch[lane])

        # Of the tiles of the 3 sigma square, keep those that the contour alpha = 1/255 can touch.
        # The contour's squared Mahalanobis distance is 2 ln(255 opacity).
        opacity = ONE / (exponential(-logit) + ONE)
        log2_opacity = log2(maximum(opacity, ALPHA_MIN))
        reach = maximum((log2_opacity - LOG2_ALPHA_MIN) * (2 / LOG2_E), ZERO)
        inner_x, outer_x = contour_range(column, square_root(reach * xx), v.tiles_x, at.TILE)
        inner_y, outer_y = contour_range(row, square_root(reach * yy), v.tiles_y, at.TILE)
        first_x, past_x = maximum(first_x, inner_x), minimum(past_x, outer_x)
        first_y, past_y = maximum(first_y, inner_y), minimum(past_y, outer_y)
        seen = visible & (opacity > ALPHA_MIN) & (first_x < past_x) & (first_y < past_y)
        todo = mask_bits(seen) & ((np.uint64(1) << np.uint64(count)) - np.uint64(1))
        if todo == 0:
            continue

        rgb = _color(degree, dc, offset, todo, start, gaussians.sh_rest, floats)
        red, green, blue = rgb
        bad += select(mask_from_bits(todo), (red + green + blue) * ZERO, ZERO)
        clamped = select(red < ZERO, splat(ONE), ZERO)
        clamped += select(green < ZERO, splat(TWO), ZERO) + select(blue < ZERO, splat(FOUR), ZERO)

        u_x, v_y = square_root(a * (0.5 * LOG2_E)), square_root((0.5 * LOG2_E) / yy)
        # One vector per entry of a record, in the order of `layout`; one row per Gaussian of them.
        entries = (
            *record_entries(column, row, (u_x, -xy / yy * u_x, v_y), log2_opacity, rgb),
            xy / xx,
            xy * square_root(reach / xx),
            z,
            as_span(first_x, past_x),
            as_span(first_y, past_y),
            index_bits(start),
            as_integers(clamped),
        )
        store_columns(rows, 0, entries)
        out = _append(out, todo, rows, records, record_ints, keys)
    flags[VISIBLE] = out - begin
    sound = mask_bits(absolute(bad) <= ZERO)  # False for NaN
    flags[BAD_VALUE] = 0 if short == 0 and sound == ALL_LANES else 1


@inlined
def _prefetch_harmonics(sh_rest, begin, end):
    """Prefetch the rows `FAR` behind the rows ``begin`` to before ``end``, seen or not."""
    for place in range((begin + FAR) * REST, (end + FAR) * REST, LANES):
        prefetch_far(sh_rest, place)


@inlined
def _zero_if_finite(vector):
    return vector[0] * ZERO + vector[1] * ZERO + vector[2] * ZERO


@inlined
def _append(out, todo, rows, records, record_ints, keys):
    """Append the ``rows`` of the lanes ``todo`` to the ``out`` records; return their new number."""
    while todo != 0:
        lane = lowest_bit(todo)
        todo &= todo - np.uint64(1)
        store(records, out * at.RECORD, load(rows, lane * np.uint64(LANES)))
        # The bits of positive float32 numbers sort like the numbers. Equal depths sort by index.
        depth = np.uint64(record_ints[out * at.RECORD + at.DEPTH])
        keys[out] = (depth << np.uint64(32)) | np.uint64(out)
        out += 1
    return out


@inlined
def _color(degree, dc, offset, todo, start, sh_rest, memory):
    """Red, green and blue: SH + 1/2, not clamped yet (3DGS, computeColorFromSH)."""
    red, green, blue = dc[0] * F0 + HALF, dc[1] * F0 + HALF, dc[2] * F0 + HALF
    if degree > 0:
        further = _harmonics(degree, offset, todo, start, sh_rest, memory)
        red += further[0]
        green += further[1]
        blue += further[2]
    return red, green, blue


@inlined
def _harmonics(degree, offset, todo, start, sh_rest, memory):
    """Red, green and blue of the harmonics above degree 0, for the lanes ``todo`` from ``start``.

    The coefficients of one Gaussian are adjacent in memory. So each Gaussian is one row: its basis
    times its coefficients, in one 16x16 matrix for each channel. All rows are summed at once.
    """
    basis, red, green = memory[:MATRIX], memory[MATRIX:], memory[2 * MATRIX :]
    blue = memory[3 * MATRIX :]
    to, _ = normalized(offset)
    fill_basis(degree, to, basis)
    while todo != 0:
        lane = lowest_bit(todo)
        todo &= todo - np.uint64(1)
        place = lane * np.uint64(LANES)
        own = load(basis, place)
        by_red, by_green, by_blue = by_channel(load_rest(sh_rest, (start + np.int64(lane)) * REST))
        store(red, place, own * by_red)
        store(green, place, own * by_green)
        store(blue, place, own * by_blue)
    return _row_sums(red, 0), _row_sums(green, 0), _row_sums(blue, 0)


@inlined
def _row_sums(array, place):
    """The sums of the 16 rows of the 16x16 matrix at ``array[place:]``; row k in lane k."""
    transpose(array, place)
    total = load(array, place)
    for k in range(1, LANES):
        total += load(array, place + k * LANES)
    return total


@inlined
def _take_rows(record, count, v, record_ints, tile_shard, rows, indices, sums):
    """Sum the gradient rows of ``count`` records over their shards, and clear the rows.

    ``sums`` [16 * 16] gets one row per entry of a gradient row; ``indices`` [16] gets the
    Gaussians. If there are fewer than 16 records, the last one is repeated.
    """
    # Rows are cleared here, while they are in the cache; clearing them before the backward pass
    # would load them again.
    for lane in range(count):
        base = (record + lane) * at.RECORD
        indices[lane] = record_ints[base + at.INDEX]
        first, last = shards_of(record_ints, base, tile_shard, v.tiles_x)
        own = record_ints[base + at.FIRST_ROW]
        total = splat(ZERO)
        for row in range(own + np.int64(first), own + np.int64(last) + 1):
            total += load(rows, row * at.ROW)
            store(rows, row * at.ROW, splat(ZERO))
        store(sums, lane * LANES, total)
    for lane in range(count, LANES):
        indices[lane] = indices[count - 1]
        store(sums, lane * LANES, load(sums, (count - 1) * LANES))
    transpose(sums, 0)


@kernel
def backproject_shards(
    first, past, memory, edges, visible, gaussians, degree, frame, rows, outputs, adam
):
    """Write the gradients of the shards ``first`` to ``past`` and clear their ``rows``.

    Shard s has the Gaussians from ``edges[s]`` to ``edges[s + 1]``, of which ``visible[s]`` have
    records. ``rows`` is [rows * 16]. ``outputs`` are the gradients by the
    parameters, by the screen points [N, 2], the absolute ones [N, 2] and the extra output
    [N, C]; the last two are empty if not requested.

    If ``adam`` has factors, the parameters are stepped, too, `layout.CHUNK` Gaussians at a time.
    The gradients by the parameters then have one chunk of rows for each shard, of which a call uses
    that of its first one; it stays in the cache.
    """
    steps, own_chunk = len(adam.factors) > 0, first * at.CHUNK
    scratch = memory[0][first], memory[1][first]
    for shard in range(first, past):
        begin, end = edges[shard], edges[shard + 1]
        record, last = begin, begin + visible[shard]
        for start in range(begin, end, at.CHUNK):
            stop, origin = min(start + at.CHUNK, end), start - own_chunk if steps else 0
            past_record = record
            while past_record < last and _gaussian(frame.record_ints, past_record) < stop:
                past_record += 1
            _clear_unseen(start, stop, origin, record, past_record, frame.record_ints, outputs)
            for sixteen in range(record, past_record, LANES):
                if degree > 0:
                    last_own = min(sixteen + LANES, past_record) - 1
                    _prefetch_harmonics(
                        gaussians.sh_rest,
                        _gaussian(frame.record_ints, sixteen),
                        _gaussian(frame.record_ints, last_own) + 1,
                    )
                _backproject(
                    scratch,
                    sixteen,
                    past_record,
                    origin,
                    gaussians,
                    degree,
                    frame,
                    rows,
                    outputs,
                )
            record = past_record
            if steps:
                step_all(gaussians, adam, outputs[0], start, stop, own_chunk, scratch[0])


@inlined
def _gaussian(record_ints, record):
    return record_ints[record * at.RECORD + at.INDEX]


@inlined
def _clear_unseen(begin, end, origin, record, past_record, record_ints, outputs):
    """Set the gradients of the Gaussians from ``begin`` to ``end`` without a record to 0.

    Those with one have the records ``record`` to before ``past_record``. Row 0 of the gradients by
    the parameters is that of the Gaussian ``origin``.
    """
    gradients, g_screen, g_absolute, g_extra = outputs
    unseen = begin  # the first Gaussian whose gradients are not written yet
    for own in range(record, past_record + 1):
        past = end if own == past_record else _gaussian(record_ints, own)
        if past > unseen:
            for k in range(len(gradients)):
                _clear(gradients[k], unseen - origin, past - origin)
            _clear(g_screen, unseen, past)
            if len(g_absolute) > 0:
                _clear(g_absolute, unseen, past)
            if len(g_extra) > 0:
                _clear(g_extra, unseen, past)
        unseen = past + 1


@inlined
def _backproject(memory, record, past, origin, gaussians, degree, frame, rows, outputs):
    """Write the gradients of up to 16 Gaussians: those of the records ``record`` to ``past``.

    Row 0 of the gradients by the parameters is that of the Gaussian ``origin``.
    """
    gradients, g_screen, g_absolute, g_extra = outputs
    v, record_ints = frame.camera, frame.record_ints
    floats, indices = memory
    own = indices[LANES:]  # rows of the gradients by the parameters
    sums, colors = floats[:MATRIX], floats[3 * MATRIX :]
    count = min(LANES, past - record)
    _take_rows(record, count, v, record_ints, frame.tile_shard, rows, indices, sums)
    for lane in range(LANES):
        own[lane] = indices[lane] - origin
    mean = gather_vectors(gaussians.means, indices)
    log_scale = gather_vectors(gaussians.log_scales, indices)
    offset = from_camera(mean, v)

    # Colour. A channel below 0 was clamped and has no gradient.
    to, inverse_distance = normalized(offset)
    rgb = _unclamped(record, count, record_ints, sums, colors)
    scatter(gradients.sh_dc, own, stretched(rgb, F0))
    turned = _backproject_harmonics(
        degree, to, indices, own, gaussians.sh_rest, gradients.sh_rest, floats[MATRIX:]
    )

    # Repeat the geometry of the forward pass.
    quaternion, inverse_norm, _ = gather_quaternions(gaussians.quaternions, indices)
    x, y, z = through(view_axes(v), offset)
    inverse_z = ONE / z
    free_x, free_y = x * inverse_z, y * inverse_z
    matrix, n0, n1 = image_axes(free_x, free_y, inverse_z, quaternion, v)
    scales = exponentials(log_scale)
    _, xy, yy, a = spread(scaled(n0, scales), scaled(n1, scales))
    e, shear = ONE / yy, -xy / yy  # power = -(a t^2 + e dy^2) / 2, t = dx + shear dy
    by_u, by_v = square_root(a * TWO_LN_2), square_root(e * TWO_LN_2)  # a t / u and e dy / v

    # Mean on the image: d power / d mean = (a t, shear a t + e dy).
    g_column = by_u * load(sums, at.SUM_H_U * LANES)
    g_row = shear * g_column + by_v * load(sums, at.SUM_H_V * LANES)
    half_width, half_height = 0.5 * v.width, 0.5 * v.height  # from px to NDC
    scatter(g_screen, indices, (g_column * half_width, g_row * half_height))
    if len(g_absolute) > 0:
        across = by_u * load(sums, at.SUM_ABS_U * LANES)
        down = TWO_LN_2 * load(sums, at.SUM_ABS_Y * LANES)
        scatter(g_absolute, indices, (across * half_width, down * half_height))

    q00 = by_u * by_u * load(sums, at.SUM_H_UU * LANES)
    q01 = by_u * by_v * load(sums, at.SUM_H_UV * LANES)
    q11 = by_v * by_v * load(sums, at.SUM_H_VV * LANES)
    h = load(sums, at.SUM_H * LANES)
    if len(g_extra) > 0:
        free = image_rows(free_x, free_y, inverse_z, v)
        entries = splitting_entries(q00 - a * h, q01, q11 - e * h, shear, free)
        scatter(g_extra, indices, entries)
    g_scales, turn, s0, s1 = covariance_gradients(q00, q01, q11, n0, n1, shear, scales)
    scatter(gradients.log_scales, own, g_scales)
    g_quaternion = quaternion_gradient(quaternion, turn, inverse_norm + inverse_norm)
    scatter(gradients.quaternions, own, g_quaternion)

    # Mean: through A = J W and the position on the image, and through the view direction of the
    # colour, whose gradient is projected to the tangent of the sphere.
    a0, a1 = through(matrix, s0), through(matrix, s1)
    position = position_gradient(a0, a1, g_column, g_row, free_x, free_y, inverse_z, v)
    tangent = stretched(plus(turned, -dot(turned, to), to), inverse_distance)
    scatter(gradients.means, own, plus(position, ONE, tangent))

    # d log(alpha) / d logit = 1 - opacity
    (logit,) = gather_numbers(gaussians.logits, indices)
    scatter(gradients.logits, own, (h / (exponential(logit) + ONE),))


@inlined
def _backproject_harmonics(degree, to, indices, own, sh_rest, g_sh_rest, memory):
    """Write the gradients by ``sh_rest`` to the rows ``own``; return that by the direction ``to``.

    ``memory`` has two 16x16 matrices for scratch, then the gradients by red, green and blue.
    """
    basis, pulled, colors = memory[:MATRIX], memory[MATRIX:], memory[2 * MATRIX :]
    if degree > 0:
        fill_basis(degree, to, basis)
    for lane in range(LANES):
        source, target, place = indices[lane] * REST, own[lane] * REST, lane * LANES
        if degree > 0:
            r, g, b = colors[lane], colors[LANES + lane], colors[2 * LANES + lane]
            by_red, by_green, by_blue = by_channel(load_rest(sh_rest, source))
            store(pulled, place, by_red * r + by_green * g + by_blue * b)
            store_rest(g_sh_rest, target, outer_rest(load(basis, place), r, g, b))
        else:
            store_rest(g_sh_rest, target, (splat(ZERO), splat(ZERO), splat(ZERO)))
    return direction_gradient(degree, to, pulled)


@inlined
def _unclamped(record, count, record_ints, sums, colors):
    """Return the gradients by red, green and blue; write them to ``colors`` [3 * 16], too.

    The gradient by a clamped channel is 0.
    """
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
