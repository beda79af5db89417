"""Projection of Gaussians to records, a lane a Gaussian."""

from __future__ import annotations

import triton
import triton.language as tl

from gsbench.raster.base import CONSTANTS
from gsbench.raster.triton.geometry import (
    dot,
    from_camera,
    image_axes,
    load_quaternion,
    load_vector,
    rotation_matrix,
    scaled,
    spread,
    times,
    to_view,
)
from gsbench.raster.triton.harmonics import colors
from gsbench.raster.triton.layout import (
    ALPHA_MIN,
    BLOCK_HEIGHT,
    BLOCK_ROWS,
    BLOCK_WIDTH,
    BLUE,
    CLAMPED,
    COLOR_SLOPES,
    COLUMNS,
    CURVE_T,
    CURVE_Y,
    FIRST_ROW,
    GREEN,
    LOG2_ALPHA_MIN,
    LOG2_E,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    RECORD,
    RED,
    RIGHTMOST_Y,
    SHEAR,
    TILE,
)
from gsbench.raster.validate import MIN_QUATERNION_NORM

NEAR = tl.constexpr(CONSTANTS.near)
SIGMA_EXTENT = tl.constexpr(CONSTANTS.sigma_extent)
EIGENVALUE_FLOOR = tl.constexpr(CONSTANTS.eigenvalue_floor)
MAX_RADIUS = tl.constexpr(2.0**24)  # px; keeps the radius of an absurdly large Gaussian inside int32
MAX_CENTER = tl.constexpr(1e9)  # px; a centre so far outside the image cannot be told apart in float32
MAX_VARIANCE = tl.constexpr(1e18)  # px^2; nor can a standard deviation; squares stay finite
MIN_SQUARED_NORM = tl.constexpr(MIN_QUATERNION_NORM**2)
CONTOUR_MARGIN = tl.constexpr(0.01)  # px, and relative: rounding of the contour alpha = 1/255 must not lose a pixel
LAST_KEY = tl.constexpr(2**31 - 1)  # sorts behind every depth
UNSEEN = tl.constexpr(-1e9)  # log2(opacity)


@triton.jit
def _tile_range(low, high, tiles, SIZE: tl.constexpr):
    """First and past-the-last tile of ``SIZE`` px for the pixels ``low`` to ``high`` - 1, within the grid; int32."""
    first = tl.floor(tl.minimum(tl.maximum(low * (1.0 / SIZE), 0.0), tiles)).to(tl.int32)
    past = tl.floor(tl.minimum(tl.maximum((high + (SIZE - 1)) * (1.0 / SIZE), 0.0), tiles)).to(tl.int32)
    return first, past


@triton.jit(do_not_specialize=["count"])
def project(
    means,
    log_scales,
    quaternions,
    logits,
    sh_dc,
    sh_rest,
    count,
    v,
    records,
    record_ints,
    color_slopes,
    keys,
    row_counts,
    radii,
    flags,
    DEGREE: tl.constexpr,
    GROUP: tl.constexpr,
):
    """Fill ``radii`` [N]; of every Gaussian that can be seen its record, elsewhere rubbish, and at N one that cannot be
    seen; ``color_slopes`` [N, 9], likewise, the derivatives of colour by the direction, unless ``DEGREE`` is 0;
    ``keys`` [N] by which depth is sorted; ``row_counts`` [N], the rows of blocks that its contour can touch.
    ``flags`` [1] becomes 1 where a value is not finite or a quaternion has no length. ``record_ints`` is the memory of
    ``records`` [N + 1, 16]."""
    index = tl.program_id(0).to(tl.int64) * GROUP + tl.arange(0, GROUP)  # [GROUP]
    inside = index < count
    mean, log_scale = load_vector(means, index, inside), load_vector(log_scales, index, inside)
    dc = load_vector(sh_dc, index, inside)
    quaternion, _, squared_norm = load_quaternion(quaternions, index, inside)
    logit = tl.load(logits + index, mask=inside, other=0.0)
    total = mean[0] + mean[1] + mean[2] + log_scale[0] + log_scale[1] + log_scale[2]
    total += squared_norm + logit + dc[0] + dc[1] + dc[2]
    bad = (squared_norm < MIN_SQUARED_NORM) | ~(tl.abs(total) < float("inf"))

    offset = from_camera(mean, v)
    x, y, z = to_view(offset, v)
    visible = inside & (z > NEAR)
    inverse_z = 1.0 / tl.where(visible, z, 1.0)
    column = x * inverse_z * v.fx + v.pixel_cx
    row = y * inverse_z * v.fy + v.pixel_cy
    axis_x, axis_y, _, _ = image_axes(x * inverse_z, y * inverse_z, inverse_z, v)
    scales = (tl.exp(log_scale[0]), tl.exp(log_scale[1]), tl.exp(log_scale[2]))
    matrix = rotation_matrix(quaternion)
    m0, m1 = scaled(times(axis_x, matrix), scales), scaled(times(axis_y, matrix), scales)
    visible &= (tl.abs(column) < MAX_CENTER) & (tl.abs(row) < MAX_CENTER) & (dot(m0, m0) + dot(m1, m1) < MAX_VARIANCE)
    xx, xy, yy, a = spread(m0, m1)
    half = (xx - yy) * 0.5
    # middle^2 - det as a sum of squares
    largest = (xx + yy) * 0.5 + tl.sqrt(tl.maximum(half * half + xy * xy, EIGENVALUE_FLOOR))
    radius = tl.minimum(tl.ceil(tl.sqrt(largest) * SIGMA_EXTENT), MAX_RADIUS)
    first_x, past_x = _tile_range(column - radius, column + radius, v.tiles_x, TILE)
    first_y, past_y = _tile_range(row - radius, row + radius, v.tiles_y, TILE)
    visible &= (first_x < past_x) & (first_y < past_y)
    tl.store(radii + index, tl.where(visible, radius, 0.0).to(tl.int32), mask=inside)

    # Of the blocks of the 3 sigma square's tiles, those that the contour alpha = 1/255 can touch.
    growth = tl.exp(-logit) + 1.0
    log2_opacity = -tl.log2(growth)
    reach = tl.maximum((log2_opacity - LOG2_ALPHA_MIN) * (2 / LOG2_E), 0.0)  # its squared Mahalanobis distance
    half_x = tl.sqrt(reach * xx) * (1 + CONTOUR_MARGIN) + CONTOUR_MARGIN
    half_y = tl.sqrt(reach * yy) * (1 + CONTOUR_MARGIN) + CONTOUR_MARGIN
    inner_x, outer_x = _tile_range(tl.ceil(column - half_x), tl.floor(column + half_x) + 1, v.blocks_x, BLOCK_WIDTH)
    inner_y, outer_y = _tile_range(tl.ceil(row - half_y), tl.floor(row + half_y) + 1, v.blocks_y, BLOCK_HEIGHT)
    first_x, past_x = tl.maximum(first_x, inner_x), tl.minimum(past_x, outer_x)
    first_y, past_y = tl.maximum(first_y * BLOCK_ROWS, inner_y), tl.minimum(past_y * BLOCK_ROWS, outer_y)
    seen = visible & (growth * ALPHA_MIN < 1.0) & (first_x < past_x) & (first_y < past_y)
    tl.store(row_counts + index, tl.where(seen, past_y - first_y, 0), mask=inside)
    # The bits of a positive float32 sort like its value.
    tl.store(keys + index, tl.where(seen, z.to(tl.int32, bitcast=True), LAST_KEY), mask=inside)

    distance = tl.sqrt(dot(offset, offset))
    inverse = 1.0 / tl.where(distance > 0, distance, 1.0)
    direction = (offset[0] * inverse, offset[1] * inverse, offset[2] * inverse)
    rgb, by_x, by_y, by_z = colors(direction, dc, sh_rest, index, seen, DEGREE)
    red, green, blue = rgb
    if DEGREE > 0:
        for c in tl.static_range(3):
            tl.store(color_slopes + index * COLOR_SLOPES + 3 * c, by_x[c], mask=seen)
            tl.store(color_slopes + index * COLOR_SLOPES + 3 * c + 1, by_y[c], mask=seen)
            tl.store(color_slopes + index * COLOR_SLOPES + 3 * c + 2, by_z[c], mask=seen)
    bad |= seen & ~(tl.abs(red + green + blue) < float("inf"))
    clamped = (red < 0).to(tl.int32) + 2 * (green < 0).to(tl.int32) + 4 * (blue < 0).to(tl.int32)

    place = index * RECORD
    seen |= index == count
    log2_opacity = tl.where(inside, log2_opacity, UNSEEN)
    tl.store(records + place + MEAN_X, column, mask=seen)
    tl.store(records + place + MEAN_Y, row, mask=seen)
    tl.store(records + place + SHEAR, -xy / yy, mask=seen)
    tl.store(records + place + CURVE_T, a * (-0.5 * LOG2_E), mask=seen)
    tl.store(records + place + CURVE_Y, 1.0 / yy * (-0.5 * LOG2_E), mask=seen)
    tl.store(records + place + LOG2_OPACITY, log2_opacity, mask=seen)
    tl.store(records + place + RED, tl.maximum(red, 0.0), mask=seen)
    tl.store(records + place + GREEN, tl.maximum(green, 0.0), mask=seen)
    tl.store(records + place + BLUE, tl.maximum(blue, 0.0), mask=seen)
    tl.store(records + place + RIGHTMOST_Y, xy * tl.sqrt(reach / xx), mask=seen)
    tl.store(record_ints + place + COLUMNS, first_x + (past_x << 16), mask=seen)
    tl.store(record_ints + place + FIRST_ROW, first_y, mask=seen)
    tl.store(record_ints + place + CLAMPED, clamped, mask=seen)
    tl.store(flags, 1, mask=tl.max((bad & inside).to(tl.int32), 0) > 0)
