"""Projection of Gaussians to records, and its gradients, derived by hand; one lane per Gaussian.

Sums have a fixed order and use no atomics, so their bits are the same on every run.
"""

from __future__ import annotations

import triton
import triton.language as tl

from gsbench.raster.base import CONSTANTS
from gsbench.raster.staged import MIN_QUATERNION_NORM
from gsbench.raster.triton.geometry import (
    F0,
    colors,
    contour_range,
    covariance_gradients,
    dot,
    exponentials,
    from_camera,
    image_axes,
    image_rows,
    load_camera,
    load_quaternion,
    load_vector,
    minus,
    normalized,
    plus,
    position_gradient,
    quaternion_gradient,
    radius_of,
    record_entries,
    scaled,
    splitting_entries,
    spread,
    store_gradients,
    store_or_zero,
    store_vector,
    stretched,
    through,
    tile_range,
    view_axes,
)
from gsbench.raster.triton.layout import (
    ALPHA_MIN,
    BLOCK_HEIGHT,
    BLOCK_ROWS,
    BLOCK_WIDTH,
    CLAMPED,
    COLUMNS,
    FIRST_ROW,
    LOG2_ALPHA_MIN,
    LOG2_E,
    RECORD,
    RIGHTMOST_Y,
    ROW,
    TILE,
)
from gsbench.raster.triton.lists import lists_fit, units_that_fit

NEAR = tl.constexpr(CONSTANTS.near)
MAX_CENTER = tl.constexpr(CONSTANTS.max_center)
MAX_VARIANCE = tl.constexpr(CONSTANTS.max_variance)
MIN_SQUARED_NORM = tl.constexpr(MIN_QUATERNION_NORM**2)
LAST_KEY = tl.constexpr(2**31 - 1)  # sorts behind every depth
INVISIBLE = tl.constexpr(-1e9)  # log2(opacity) of the invisible record


@triton.jit(do_not_specialize=["count"])
def project(
    gaussians,
    count,
    camera,
    projected,
    record_ints,
    keys,
    radii,
    flags,
    DEGREE: tl.constexpr,
    GROUP: tl.constexpr,
):
    """Project all Gaussians (`Parameters`). Fills:

    - ``radii`` [N];
    - of ``projected`` (`Projected`): the records of visible Gaussians (undefined for others), with
      an invisible one at N, of which ``record_ints`` is the same memory; their ``color_slopes``,
      the derivatives of colour by the direction, unless ``DEGREE`` is 0; and ``row_counts``, the
      number of rows of blocks that the contour can touch;
    - ``keys`` [N], which sort Gaussians by depth, those that are not seen last;
    - ``flags`` [1], set to 1 if a value is not finite or a quaternion has length 0.
    """
    records = projected.records
    v = load_camera(camera)
    index = tl.program_id(0).to(tl.int64) * GROUP + tl.arange(0, GROUP)  # [GROUP]
    inside = index < count
    mean = load_vector(gaussians.means, index, inside)
    log_scale = load_vector(gaussians.log_scales, index, inside)
    dc = load_vector(gaussians.sh_dc, index, inside)
    quaternion, _, squared_norm = load_quaternion(gaussians.quaternions, index, inside)
    logit = tl.load(gaussians.opacity_logits + index, mask=inside, other=0.0)
    total = mean[0] + mean[1] + mean[2] + log_scale[0] + log_scale[1] + log_scale[2]
    total += squared_norm + logit + dc[0] + dc[1] + dc[2]
    bad = (squared_norm < MIN_SQUARED_NORM) | ~(tl.abs(total) < float("inf"))

    # The mean on the image, px: (fx x / z + cx - 1/2, fy y / z + cy - 1/2).
    offset = from_camera(mean, v)
    x, y, z = through(view_axes(v), offset)
    visible = inside & (z > NEAR)
    inverse_z = 1.0 / tl.where(visible, z, 1.0)
    free_x, free_y = x * inverse_z, y * inverse_z
    column, row = free_x * v.fx + v.pixel_cx, free_y * v.fy + v.pixel_cy
    _, n0, n1 = image_axes(free_x, free_y, inverse_z, quaternion, v)
    scales = exponentials(log_scale)
    m0, m1 = scaled(n0, scales), scaled(n1, scales)
    visible &= (tl.abs(column) < MAX_CENTER) & (tl.abs(row) < MAX_CENTER)
    visible &= dot(m0, m0) + dot(m1, m1) < MAX_VARIANCE
    xx, xy, yy, a = spread(m0, m1)
    radius = radius_of(xx, xy, yy)
    first_x, past_x = tile_range(column - radius, column + radius, v.tiles_x, TILE)
    first_y, past_y = tile_range(row - radius, row + radius, v.tiles_y, TILE)
    visible &= (first_x < past_x) & (first_y < past_y)
    tl.store(radii + index, tl.where(visible, radius, 0.0).to(tl.int32), mask=inside)

    # Of the blocks in the tiles of the 3 sigma square, keep those that the contour alpha = 1/255
    # can touch. The contour's squared Mahalanobis distance is 2 ln(255 opacity).
    growth = tl.exp(-logit) + 1.0
    log2_opacity = -tl.log2(growth)
    reach = tl.maximum((log2_opacity - LOG2_ALPHA_MIN) * (2 / LOG2_E), 0.0)
    blocks_x = tl.ceil(v.width * (1.0 / BLOCK_WIDTH))
    blocks_y = tl.ceil(v.height * (1.0 / BLOCK_HEIGHT))
    inner_x, outer_x = contour_range(column, tl.sqrt(reach * xx), blocks_x, BLOCK_WIDTH)
    inner_y, outer_y = contour_range(row, tl.sqrt(reach * yy), blocks_y, BLOCK_HEIGHT)
    first_x, past_x = tl.maximum(first_x, inner_x), tl.minimum(past_x, outer_x)
    first_y = tl.maximum(first_y * BLOCK_ROWS, inner_y)
    past_y = tl.minimum(past_y * BLOCK_ROWS, outer_y)
    seen = visible & (growth * ALPHA_MIN < 1.0) & (first_x < past_x) & (first_y < past_y)
    row_counts = tl.where(seen, past_y - first_y, 0).to(tl.int32)
    tl.store(projected.row_counts + index, row_counts, mask=inside)
    # The bits of positive float32 numbers sort like the numbers.
    tl.store(keys + index, tl.where(seen, z.to(tl.int32, bitcast=True), LAST_KEY), mask=inside)

    direction, _ = normalized(offset)
    rgb, by_x, by_y, by_z = colors(direction, dc, gaussians.sh_rest, index, seen, DEGREE)
    red, green, blue = rgb
    if DEGREE > 0:
        for c in tl.static_range(3):
            slopes = projected.color_slopes + 3 * c
            store_vector(slopes, 3 * index, (by_x[c], by_y[c], by_z[c]), seen)
    bad |= seen & ~(tl.abs(red + green + blue) < float("inf"))
    clamped = (red < 0).to(tl.int32) + 2 * (green < 0).to(tl.int32) + 4 * (blue < 0).to(tl.int32)

    place = index * RECORD
    seen |= index == count
    log2_opacity = tl.where(inside, log2_opacity, INVISIBLE)
    form = -xy / yy, a * (-0.5 * LOG2_E), 1.0 / yy * (-0.5 * LOG2_E)
    entries = record_entries(column, row, form, log2_opacity, rgb)
    for k in tl.static_range(9):
        tl.store(records + place + k, entries[k], mask=seen)
    tl.store(records + place + RIGHTMOST_Y, xy * tl.sqrt(reach / xx), mask=seen)
    columns = first_x.to(tl.int32) + (past_x.to(tl.int32) << 16)
    tl.store(record_ints + place + COLUMNS, columns, mask=seen)
    tl.store(record_ints + place + FIRST_ROW, first_y.to(tl.int32), mask=seen)
    tl.store(record_ints + place + CLAMPED, clamped, mask=seen)
    tl.store(flags, 1, mask=tl.max((bad & inside).to(tl.int32), 0) > 0)


@triton.jit(do_not_specialize=["units", "pairs"])
def sum_units(found, last_slots, units, pairs, rows, GROUP: tl.constexpr):
    """Sum the ``rows`` [pairs, 16] of each unit of ``found`` (`Units`), into its first row.

    Only rows of entries that compositing reached have been written. These are the slots up to
    ``last_slots`` [blocks], because the slots in the list of a block rise.
    """
    unit = tl.program_id(0).to(tl.int64) * GROUP + tl.arange(0, GROUP)  # [GROUP]
    inside = unit < units_that_fit(found.status, units, pairs)
    width = tl.load(found.widths + unit, mask=inside, other=0)
    first = tl.load(found.pair_ends + unit, mask=inside, other=0) - width
    block = tl.load(found.blocks + unit, mask=inside, other=0)
    place = rows + first[:, None] * ROW + tl.arange(0, ROW)[None, :]  # [GROUP, ROW]
    total = tl.zeros([GROUP, ROW], tl.float32)
    for k in range(0, tl.max(width, 0)):
        written = first + k <= tl.load(last_slots + block + k, mask=k < width, other=-1)
        total += tl.load(place + k * ROW, mask=(written & (k < width))[:, None], other=0.0)
    written = first <= tl.load(last_slots + block, mask=width == 1, other=-1)
    tl.store(place, total, mask=((width > 1) | ((width == 1) & ~written))[:, None])


@triton.jit
def sum_rows(index, own_rows, found, rows, NUMBERS: tl.constexpr):
    """Sum the first ``NUMBERS`` columns of the ``rows`` of each Gaussian over its units.

    ``own_rows`` is the number of units of each Gaussian, ``found`` are `Units`. ``sum_units`` has
    already summed the pairs of each unit into the row of its first pair.
    """
    unit = tl.load(found.first + index, mask=own_rows > 0, other=0)
    zero = tl.zeros_like(own_rows).to(tl.float32)
    # Triton's tuples grow by ``+``; it knows neither ``*`` nor comprehensions.
    sums = ()
    for _ in tl.static_range(NUMBERS):
        sums = sums + (zero,)  # type: ignore[assignment]  # noqa: RUF005
    for k in range(0, tl.max(own_rows, 0)):
        active = k < own_rows
        width = tl.load(found.widths + unit + k, mask=active, other=0)
        slot = tl.load(found.pair_ends + unit + k, mask=active, other=0) - width
        grown = ()
        for n in tl.static_range(NUMBERS):
            own = tl.load(rows + slot * ROW + n, mask=width > 0, other=0.0)
            grown = grown + (sums[n] + own,)  # type: ignore[assignment]  # noqa: RUF005
        sums = grown
    return sums


@triton.jit
def _turned(to, inverse_distance, g_rgb, color_slopes, index, mask, DEGREE: tl.constexpr):
    """The gradient by the mean through the view direction ``to``, which changes the colour."""
    zero = tl.zeros_like(inverse_distance)
    turned = (zero, zero, zero)
    if DEGREE > 0:
        for c in tl.static_range(3):
            turned = plus(turned, g_rgb[c], load_vector(color_slopes + 3 * c, 3 * index, mask))
    # Only the part of the gradient that is tangent to the unit sphere turns the direction.
    return stretched(minus(turned, dot(turned, to), to), inverse_distance)


@triton.jit
def store_splitting(g_extra, index, d00, d01, d11, shear, rows, seen, inside):
    """Write the splitting matrices to ``g_extra`` [N, 9]; see `formulas.splitting_entries`."""
    entries = splitting_entries(d00, d01, d11, shear, rows)
    for k in tl.static_range(9):
        store_or_zero(g_extra + 9 * index + k, entries[k], seen, inside)


@triton.jit(do_not_specialize=["count", "units", "pairs"])
def backproject(
    gaussians,
    count,
    camera,
    projected,
    record_ints,
    found,
    units,
    pairs,
    rows,
    gradients,
    g_screen,
    g_absolute,
    g_extra,
    DEGREE: tl.constexpr,
    ABSOLUTE: tl.constexpr,
    EXTRA: tl.constexpr,
    GROUP: tl.constexpr,
):
    """Write the ``gradients`` of Gaussians that are seen: those with units.

    Other gradients are not changed, except that ``g_screen``, ``g_absolute`` and ``g_extra``
    become 0. ``EXTRA`` is the function that writes ``g_extra``, such as `store_splitting`, or None.
    See `lists_fit` for ``units`` and ``pairs``.
    """
    v = load_camera(camera)
    index = tl.program_id(0).to(tl.int64) * GROUP + tl.arange(0, GROUP)  # [GROUP]
    inside = index < count
    seeable = inside & lists_fit(found.status, units, pairs)
    row_count = tl.load(projected.row_counts + index, mask=seeable, other=0)
    seen = row_count > 0
    sums = sum_rows(index, row_count, found, rows, 9 + 2 * ABSOLUTE)
    h, h_t, h_y, h_tt, h_ty, h_yy, red, green, blue = sums[:9]
    mean = load_vector(gaussians.means, index, seen)
    log_scale = load_vector(gaussians.log_scales, index, seen)
    offset = from_camera(mean, v)

    # Colour. A channel below 0 was clamped and has no gradient.
    clamped = tl.load(record_ints + index * RECORD + CLAMPED, mask=seen, other=0)
    g_rgb = (
        tl.where(clamped & 1 != 0, 0.0, red),
        tl.where(clamped & 2 != 0, 0.0, green),
        tl.where(clamped & 4 != 0, 0.0, blue),
    )
    store_vector(gradients.sh_dc, index, stretched(g_rgb, F0), seen)
    to, inverse_distance = normalized(offset)
    slopes = projected.color_slopes
    tangent = _turned(to, inverse_distance, g_rgb, slopes, index, seen, DEGREE)

    # Repeat the geometry of the forward pass.
    quaternion, inverse_norm, _ = load_quaternion(gaussians.quaternions, index, seen)
    x, y, z = through(view_axes(v), offset)
    inverse_z = 1.0 / tl.where(seen, z, 1.0)
    free_x, free_y = x * inverse_z, y * inverse_z
    matrix, n0, n1 = image_axes(free_x, free_y, inverse_z, quaternion, v)
    scales = exponentials(log_scale)
    _, xy, yy, a = spread(scaled(n0, scales), scaled(n1, scales))
    e, shear = 1.0 / yy, -xy / yy  # power = -(a t^2 + e dy^2) / 2, t = dx + shear dy

    # Mean on the image: d power / d mean = (a t, shear a t + e dy).
    g_column = a * h_t
    g_row = shear * g_column + e * h_y
    half_width, half_height = 0.5 * v.width, 0.5 * v.height
    store_or_zero(g_screen + 2 * index, g_column * half_width, seen, inside)
    store_or_zero(g_screen + 2 * index + 1, g_row * half_height, seen, inside)
    if ABSOLUTE:
        store_or_zero(g_absolute + 2 * index, a * sums[9] * half_width, seen, inside)
        store_or_zero(g_absolute + 2 * index + 1, sums[10] * half_height, seen, inside)

    q00, q01, q11 = a * a * h_tt, a * e * h_ty, e * e * h_yy
    if EXTRA is not None:
        free = image_rows(free_x, free_y, inverse_z, v)
        EXTRA(g_extra, index, q00 - a * h, q01, q11 - e * h, shear, free, seen, inside)
    g_scales, turn, s0, s1 = covariance_gradients(q00, q01, q11, n0, n1, shear, scales)
    store_vector(gradients.log_scales, index, g_scales, seen)
    g_quaternion = quaternion_gradient(quaternion, turn, inverse_norm + inverse_norm)
    place = gradients.quaternions + 4 * index
    for k in tl.static_range(4):
        tl.store(place + k, g_quaternion[k], mask=seen)

    # The mean: through A = J W and the position on the image, and through the colour.
    a0, a1 = through(matrix, s0), through(matrix, s1)
    position = position_gradient(a0, a1, g_column, g_row, free_x, free_y, inverse_z, v)
    store_vector(gradients.means, index, plus(position, 1.0, tangent), seen)

    # d log(alpha) / d logit = 1 - opacity
    g_logit = h / (tl.exp(tl.load(gaussians.opacity_logits + index, mask=seen, other=0.0)) + 1.0)
    tl.store(gradients.opacity_logits + index, g_logit, mask=seen)
    # Last, when few other values need registers.
    store_gradients(to, g_rgb, gradients.sh_rest, index, seen, DEGREE)
