"""From Gaussians to records, and from the sums of compositing back to the gradients of the parameters.

Geometry is computed in float64: the 2D covariance of a needle loses too many digits in float32. One call handles a shard:
the Gaussians ``begin`` to ``end``. Its visible ones become records ``begin``, ``begin + 1``, ... in the order of their index.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.harmonics import direction_gradient, fill_basis
from gsbench.raster.cpu.jit import inlined, kernel

HALF_LOG2_E = 0.5 / math.log(2.0)
MAX_RADIUS = 2.0**24  # px; keeps the radius of an absurdly large Gaussian inside int32
MAX_CENTER = 1e9  # px; a centre so far outside the image cannot be told apart in float32
MIN_NORM_SQUARED = 1e-24  # the square of validate.MIN_QUATERNION_NORM
CONTOUR_MARGIN = 0.01  # px, and relative: rounding of the contour alpha = 1/255 must not lose a pixel

# Flags of a shard
VISIBLE, BAD_VALUE = 0, 1


@inlined
def _rotation(q: Any, i: int) -> Any:
    """The unit quaternion and the inverse norm of quaternion i."""
    w, x, y, z = np.float64(q[i, 0]), np.float64(q[i, 1]), np.float64(q[i, 2]), np.float64(q[i, 3])
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse


@inlined
def _matrix(w: Any, x: Any, y: Any, z: Any) -> Any:
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@inlined
def _to_view(means: Any, i: int, v: Any) -> Any:
    mx, my, mz = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
    x = v.r00 * mx + v.r01 * my + v.r02 * mz + v.tx
    y = v.r10 * mx + v.r11 * my + v.r12 * mz + v.ty
    z = v.r20 * mx + v.r21 * my + v.r22 * mz + v.tz
    return x, y, z


@inlined
def _image_axes(x: Any, y: Any, inverse_z: Any, v: Any) -> Any:
    """J W, the derivative of the pixel with respect to the world position, as two rows; the clamped slopes."""
    slope_x = min(max(x * inverse_z, v.slope_x_min), v.slope_x_max)
    slope_y = min(max(y * inverse_z, v.slope_y_min), v.slope_y_max)
    jx, jy = v.fx * inverse_z, v.fy * inverse_z
    first = (jx * (v.r00 - slope_x * v.r20), jx * (v.r01 - slope_x * v.r21), jx * (v.r02 - slope_x * v.r22))
    second = (jy * (v.r10 - slope_y * v.r20), jy * (v.r11 - slope_y * v.r21), jy * (v.r12 - slope_y * v.r22))
    return first, second, slope_x, slope_y


@inlined
def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def _spread(row: Any, matrix: Any, scales: Any) -> Any:
    """``row`` [3] times the rotation ``matrix`` [3, 3] times the diagonal of ``scales``."""
    return (
        (row[0] * matrix[0][0] + row[1] * matrix[1][0] + row[2] * matrix[2][0]) * scales[0],
        (row[0] * matrix[0][1] + row[1] * matrix[1][1] + row[2] * matrix[2][1]) * scales[1],
        (row[0] * matrix[0][2] + row[1] * matrix[1][2] + row[2] * matrix[2][2]) * scales[2],
    )


@inlined
def _determinant(m0: Any, m1: Any, xx: Any, yy: Any, blur: Any) -> Any:
    """det(M M^T + blur I) without cancellation: det(M M^T) is the squared cross product of M's rows."""
    cx = m0[1] * m1[2] - m0[2] * m1[1]
    cy = m0[2] * m1[0] - m0[0] * m1[2]
    cz = m0[0] * m1[1] - m0[1] * m1[0]
    return cx * cx + cy * cy + cz * cz + blur * (xx + yy - blur)  # xx and yy have the blur in them


@inlined
def _tile_range(low: Any, high: Any, tiles: int) -> Any:
    """First and past-the-last tile for the pixels ``low`` to ``high`` - 1, within the grid."""
    first = math.floor(min(max(low / at.TILE, 0.0), np.float64(tiles)))
    past = math.floor(min(max((high + (at.TILE - 1)) / at.TILE, 0.0), np.float64(tiles)))
    return np.int32(first), np.int32(past)


@kernel
def project_shard(
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
    """Fill ``records`` [N * 16], ``keys`` [N] (depth, then record), ``radii`` [N]; ``flags``: visible records, bad value."""
    basis = np.empty(16, np.float32)
    out = begin
    bad = np.float32(0.0)
    short = False
    coefficients = (degree + 1) * (degree + 1) - 1
    for i in range(begin, end):
        radii[i] = 0
        for c in range(3):
            bad += (means[i, c] - means[i, c]) + (log_scales[i, c] - log_scales[i, c]) + (sh_dc[i, c] - sh_dc[i, c])
        for c in range(4):
            bad += quaternions[i, c] - quaternions[i, c]
        bad += logits[i] - logits[i]
        w, qx, qy, qz, inverse_norm = _rotation(quaternions, i)
        if not inverse_norm * inverse_norm * MIN_NORM_SQUARED < 1.0:
            short = True
            continue

        x, y, z = _to_view(means, i, v)
        if not z > v.near:
            continue
        inverse_z = 1.0 / z
        u = v.fx * x * inverse_z + v.pixel_cx
        w_ = v.fy * y * inverse_z + v.pixel_cy
        if not (abs(u) < MAX_CENTER and abs(w_) < MAX_CENTER):
            continue
        row_x, row_y, _, _ = _image_axes(x, y, inverse_z, v)
        scales = (
            math.exp(np.float64(log_scales[i, 0])),
            math.exp(np.float64(log_scales[i, 1])),
            math.exp(np.float64(log_scales[i, 2])),
        )
        matrix = _matrix(w, qx, qy, qz)
        m0, m1 = _spread(row_x, matrix, scales), _spread(row_y, matrix, scales)
        xx, xy, yy = _dot(m0, m0) + v.blur, _dot(m0, m1), _dot(m1, m1) + v.blur
        determinant = _determinant(m0, m1, xx, yy, v.blur)
        if not determinant < np.inf:
            continue
        half = 0.5 * (xx - yy)
        # mid^2 - det as a sum of squares
        largest = 0.5 * (xx + yy) + math.sqrt(max(v.eigenvalue_floor, half * half + xy * xy))
        radius = min(math.ceil(v.sigma_extent * math.sqrt(largest)), MAX_RADIUS)
        x0, x1 = _tile_range(u - radius, u + radius, v.tiles_x)
        y0, y1 = _tile_range(w_ - radius, w_ + radius, v.tiles_y)
        if x0 >= x1 or y0 >= y1:
            continue
        radii[i] = np.int32(radius)

        opacity = 1.0 / (1.0 + math.exp(-np.float64(logits[i])))
        reach = 2.0 * math.log(opacity / v.alpha_min)  # Mahalanobis distance squared at alpha = 1/255
        if not reach > 0.0:
            continue
        half_x = math.sqrt(reach * xx) * (1.0 + CONTOUR_MARGIN) + CONTOUR_MARGIN
        half_y = math.sqrt(reach * yy) * (1.0 + CONTOUR_MARGIN) + CONTOUR_MARGIN
        cx0, cx1 = _tile_range(math.ceil(u - half_x), math.floor(u + half_x) + 1.0, v.tiles_x)
        cy0, cy1 = _tile_range(math.ceil(w_ - half_y), math.floor(w_ + half_y) + 1.0, v.tiles_y)
        x0, x1, y0, y1 = max(x0, cx0), min(x1, cx1), max(y0, cy0), min(y1, cy1)
        if x0 >= x1 or y0 >= y1:
            continue

        dx, dy, dz = means[i, 0] - v.center_x, means[i, 1] - v.center_y, means[i, 2] - v.center_z
        inverse = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
        fill_basis(degree, np.float32(dx * inverse), np.float32(dy * inverse), np.float32(dz * inverse), basis)
        red, green, blue = basis[0] * sh_dc[i, 0], basis[0] * sh_dc[i, 1], basis[0] * sh_dc[i, 2]
        for k in range(coefficients):
            red += basis[k + 1] * sh_rest[i, 3 * k]
            green += basis[k + 1] * sh_rest[i, 3 * k + 1]
            blue += basis[k + 1] * sh_rest[i, 3 * k + 2]
        bad += (red - red) + (green - green) + (blue - blue)
        red, green, blue = red + np.float32(0.5), green + np.float32(0.5), blue + np.float32(0.5)
        clamped = (1 if red < 0 else 0) + (2 if green < 0 else 0) + (4 if blue < 0 else 0)

        base = out * at.RECORD
        records[base + at.MEAN_X] = u
        records[base + at.MEAN_Y] = w_
        records[base + at.SHEAR] = -xy / yy
        records[base + at.CURVE_T] = -HALF_LOG2_E * yy / determinant
        records[base + at.CURVE_Y] = -HALF_LOG2_E / yy
        records[base + at.LOG2_OPACITY] = math.log2(opacity)
        records[base + at.RED] = max(red, np.float32(0))
        records[base + at.GREEN] = max(green, np.float32(0))
        records[base + at.BLUE] = max(blue, np.float32(0))
        records[base + at.SLOPE] = xy / xx
        records[base + at.RIGHTMOST_Y] = xy * math.sqrt(reach / xx)
        record_ints[base + at.TILES_X] = x0 + (x1 << 16)
        record_ints[base + at.TILES_Y] = y0 + (y1 << 16)
        record_ints[base + at.INDEX] = i
        record_ints[base + at.CLAMPED] = clamped
        records[base + at.DEPTH] = z
        # The bits of a positive float32 sort like its value; equal depths in the order of the index.
        keys[out] = (np.uint64(record_ints[base + at.DEPTH]) << np.uint64(32)) | np.uint64(out)
        out += 1
    flags[VISIBLE] = out - begin
    flags[BAD_VALUE] = 1 if short or bad != 0 else 0


@kernel
def backproject_shard(
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
    records: Any,
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
    absolute: bool,
) -> None:
    """Write every gradient of the Gaussians ``begin`` to ``end``; consumes and clears their ``rows`` [shards, N * 16]."""
    basis = np.empty(16, np.float32)
    g_basis = np.empty(16, np.float32)
    total = np.empty(at.ROW, np.float64)
    coefficients = (degree + 1) * (degree + 1) - 1
    record = begin
    for i in range(begin, end):
        base = record * at.RECORD
        if record >= begin + visible or record_ints[base + at.INDEX] != i:
            g_means[i, 0] = g_means[i, 1] = g_means[i, 2] = 0
            g_log_scales[i, 0] = g_log_scales[i, 1] = g_log_scales[i, 2] = 0
            g_quaternions[i, 0] = g_quaternions[i, 1] = g_quaternions[i, 2] = g_quaternions[i, 3] = 0
            g_logits[i] = 0
            g_sh_dc[i, 0] = g_sh_dc[i, 1] = g_sh_dc[i, 2] = 0
            for k in range(45):
                g_sh_rest[i, k] = 0
            g_screen[i, 0] = g_screen[i, 1] = 0
            if absolute:
                g_absolute[i, 0] = g_absolute[i, 1] = 0
            continue
        record += 1

        # The sums over all shards of tiles that this Gaussian's tiles lie in.
        tx, ty = record_ints[base + at.TILES_X], record_ints[base + at.TILES_Y]
        first = tile_shard[(ty & 0xFFFF) * v.tiles_x + (tx & 0xFFFF)]
        last = tile_shard[((ty >> 16) - 1) * v.tiles_x + (tx >> 16) - 1]
        for k in range(at.ROW):
            total[k] = rows[first, base + k]
            rows[first, base + k] = 0
        for shard in range(first + 1, last + 1):
            for k in range(at.ROW):
                total[k] += rows[shard, base + k]
                rows[shard, base + k] = 0

        # Forward geometry once more.
        qw, qx, qy, qz, inverse_norm = _rotation(quaternions, i)
        matrix = _matrix(qw, qx, qy, qz)
        x, y, z = _to_view(means, i, v)
        inverse_z = 1.0 / z
        row_x, row_y, slope_x, slope_y = _image_axes(x, y, inverse_z, v)
        scales = (
            math.exp(np.float64(log_scales[i, 0])),
            math.exp(np.float64(log_scales[i, 1])),
            math.exp(np.float64(log_scales[i, 2])),
        )
        m0, m1 = _spread(row_x, matrix, scales), _spread(row_y, matrix, scales)
        xx, xy, yy = _dot(m0, m0) + v.blur, _dot(m0, m1), _dot(m1, m1) + v.blur
        determinant = _determinant(m0, m1, xx, yy, v.blur)
        a, e, shear = yy / determinant, 1.0 / yy, -xy / yy  # power = -(a t^2 + e dy^2) / 2, t = dx + shear dy

        # Mean on the image: d power / d mean = (a t, shear a t + e dy).
        gu = a * total[at.SUM_H_T]
        gw = shear * gu + e * total[at.SUM_H_Y]
        g_screen[i, 0] = gu * (0.5 * v.width)
        g_screen[i, 1] = gw * (0.5 * v.height)
        if absolute:
            g_absolute[i, 0] = a * total[at.SUM_ABS_T] * (0.5 * v.width)
            g_absolute[i, 1] = total[at.SUM_ABS_Y] * (0.5 * v.height)

        # Spread M [2, 3], covariance M M^T: d loss / d M = U^T (D G D) (U M), with D = diag(a, e), U = [[1, shear], [0, 1]]
        # and G the second moments of h over (t, dy).
        p00, p01, p11 = a * a * total[at.SUM_H_TT], a * e * total[at.SUM_H_TY], e * e * total[at.SUM_H_YY]
        n0 = (m0[0] + shear * m1[0], m0[1] + shear * m1[1], m0[2] + shear * m1[2])
        g0 = (p00 * n0[0] + p01 * m1[0], p00 * n0[1] + p01 * m1[1], p00 * n0[2] + p01 * m1[2])
        h1 = (p01 * n0[0] + p11 * m1[0], p01 * n0[1] + p11 * m1[1], p01 * n0[2] + p11 * m1[2])
        g1 = (shear * g0[0] + h1[0], shear * g0[1] + h1[1], shear * g0[2] + h1[2])

        # M = A R S with A = J W: scales and rotation.
        for k in range(3):
            g_log_scales[i, k] = g0[k] * m0[k] + g1[k] * m1[k]
        s0 = (g0[0] * scales[0], g0[1] * scales[1], g0[2] * scales[2])
        s1 = (g1[0] * scales[0], g1[1] * scales[1], g1[2] * scales[2])
        r00, r01, r02 = row_x[0] * s0[0] + row_y[0] * s1[0], row_x[0] * s0[1] + row_y[0] * s1[1], row_x[0] * s0[2] + row_y[0] * s1[2]
        r10, r11, r12 = row_x[1] * s0[0] + row_y[1] * s1[0], row_x[1] * s0[1] + row_y[1] * s1[1], row_x[1] * s0[2] + row_y[1] * s1[2]
        r20, r21, r22 = row_x[2] * s0[0] + row_y[2] * s1[0], row_x[2] * s0[1] + row_y[2] * s1[1], row_x[2] * s0[2] + row_y[2] * s1[2]
        gqw = 2 * (qx * (r21 - r12) + qy * (r02 - r20) + qz * (r10 - r01))
        gqx = 2 * (qw * (r21 - r12) + qy * (r01 + r10) + qz * (r02 + r20) - 2 * qx * (r11 + r22))
        gqy = 2 * (qw * (r02 - r20) + qx * (r01 + r10) + qz * (r12 + r21) - 2 * qy * (r00 + r22))
        gqz = 2 * (qw * (r10 - r01) + qx * (r02 + r20) + qy * (r12 + r21) - 2 * qz * (r00 + r11))
        along = gqw * qw + gqx * qx + gqy * qy + gqz * qz
        g_quaternions[i, 0] = (gqw - along * qw) * inverse_norm
        g_quaternions[i, 1] = (gqx - along * qx) * inverse_norm
        g_quaternions[i, 2] = (gqy - along * qy) * inverse_norm
        g_quaternions[i, 3] = (gqz - along * qz) * inverse_norm

        # A = J W: d loss / d A, taken back through W to J, then to the view position.
        a0 = (_dot(s0, matrix[0]), _dot(s0, matrix[1]), _dot(s0, matrix[2]))
        a1 = (_dot(s1, matrix[0]), _dot(s1, matrix[1]), _dot(s1, matrix[2]))
        j00 = a0[0] * v.r00 + a0[1] * v.r01 + a0[2] * v.r02
        j02 = a0[0] * v.r20 + a0[1] * v.r21 + a0[2] * v.r22
        j11 = a1[0] * v.r10 + a1[1] * v.r11 + a1[2] * v.r12
        j12 = a1[0] * v.r20 + a1[1] * v.r21 + a1[2] * v.r22
        fx_z, fy_z = v.fx * inverse_z, v.fy * inverse_z
        gz = -inverse_z * (fx_z * (j00 - slope_x * j02) + fy_z * (j11 - slope_y * j12))
        g_slope_x, g_slope_y = -fx_z * j02, -fy_z * j12
        gx, gy = gu * fx_z, gw * fy_z
        gz -= (gx * x + gy * y) * inverse_z
        if v.slope_x_min <= x * inverse_z <= v.slope_x_max:
            gx += g_slope_x * inverse_z
            gz -= g_slope_x * x * inverse_z * inverse_z
        if v.slope_y_min <= y * inverse_z <= v.slope_y_max:
            gy += g_slope_y * inverse_z
            gz -= g_slope_y * y * inverse_z * inverse_z
        g_mean_x = v.r00 * gx + v.r10 * gy + v.r20 * gz
        g_mean_y = v.r01 * gx + v.r11 * gy + v.r21 * gz
        g_mean_z = v.r02 * gx + v.r12 * gy + v.r22 * gz

        g_logits[i] = total[at.SUM_H] / (1.0 + math.exp(np.float64(logits[i])))  # d log(alpha) / d logit = 1 - opacity

        # Colour.
        clamped = record_ints[base + at.CLAMPED]
        red = np.float32(0) if clamped & 1 else np.float32(total[at.SUM_RED])
        green = np.float32(0) if clamped & 2 else np.float32(total[at.SUM_GREEN])
        blue = np.float32(0) if clamped & 4 else np.float32(total[at.SUM_BLUE])
        dx, dy, dz = means[i, 0] - v.center_x, means[i, 1] - v.center_y, means[i, 2] - v.center_z
        inverse = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
        fill_basis(degree, np.float32(dx), np.float32(dy), np.float32(dz), basis)
        g_sh_dc[i, 0], g_sh_dc[i, 1], g_sh_dc[i, 2] = basis[0] * red, basis[0] * green, basis[0] * blue
        for k in range(coefficients):
            g_basis[k + 1] = red * sh_rest[i, 3 * k] + green * sh_rest[i, 3 * k + 1] + blue * sh_rest[i, 3 * k + 2]
            g_sh_rest[i, 3 * k] = basis[k + 1] * red
            g_sh_rest[i, 3 * k + 1] = basis[k + 1] * green
            g_sh_rest[i, 3 * k + 2] = basis[k + 1] * blue
        for k in range(3 * coefficients, 45):
            g_sh_rest[i, k] = 0
        if degree > 0:
            hx, hy, hz = direction_gradient(degree, np.float32(dx), np.float32(dy), np.float32(dz), g_basis)
            radial = hx * dx + hy * dy + hz * dz
            g_mean_x += (hx - radial * dx) * inverse
            g_mean_y += (hy - radial * dy) * inverse
            g_mean_z += (hz - radial * dz) * inverse
        g_means[i, 0], g_means[i, 1], g_means[i, 2] = g_mean_x, g_mean_y, g_mean_z
