"""Projection geometry and spherical harmonics for both passes, float32, one lane per Gaussian.

Matrices are tuples of rows, and vectors are tuples. No formula subtracts large numbers (see
``spread``).
"""

from __future__ import annotations

import triton
import triton.language as tl

from gsbench.gaussians.model import C0, C1, C2, C3, NUM_SH_REST
from gsbench.raster.base import CONSTANTS

BLUR = tl.constexpr(CONSTANTS.blur)
F0, F1 = tl.constexpr(C0), tl.constexpr(C1)
D0, D1, D2, D3, D4 = (tl.constexpr(value) for value in C2)
T0, T1, T2, T3, T4, T5, T6 = (tl.constexpr(value) for value in C3)
REST = tl.constexpr(3 * NUM_SH_REST)  # numbers of one Gaussian in ``sh_rest``


@triton.jit
def load_vector(array, index, mask):
    """Load the rows ``index`` of an array [N, 3]; 0 outside ``mask``."""
    place = array + 3 * index
    return (
        tl.load(place, mask=mask, other=0.0),
        tl.load(place + 1, mask=mask, other=0.0),
        tl.load(place + 2, mask=mask, other=0.0),
    )


@triton.jit
def load_quaternion(quaternions, index, mask):
    """The unit quaternions (w, x, y, z), and the inverse norm and the squared norm of the stored
    ones."""
    place = quaternions + 4 * index
    w = tl.load(place, mask=mask, other=1.0)
    x = tl.load(place + 1, mask=mask, other=0.0)
    y = tl.load(place + 2, mask=mask, other=0.0)
    z = tl.load(place + 3, mask=mask, other=0.0)
    squared = w * w + x * x + y * y + z * z
    inverse = 1.0 / tl.sqrt(squared)
    return (w * inverse, x * inverse, y * inverse, z * inverse), inverse, squared


@triton.jit
def rotation_matrix(q):
    """The rows of the rotation matrix of a unit quaternion."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@triton.jit
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def times(row, matrix):
    """``row`` [3] times ``matrix`` [3, 3]."""
    return (
        row[0] * matrix[0][0] + row[1] * matrix[1][0] + row[2] * matrix[2][0],
        row[0] * matrix[0][1] + row[1] * matrix[1][1] + row[2] * matrix[2][1],
        row[0] * matrix[0][2] + row[1] * matrix[1][2] + row[2] * matrix[2][2],
    )


@triton.jit
def scaled(row, scales):
    return row[0] * scales[0], row[1] * scales[1], row[2] * scales[2]


@triton.jit
def from_camera(mean, v):
    """The vector from the camera centre to the mean, in world axes.

    It is computed first: rotating the difference loses no digits, even if the scene is far from the
    origin.
    """
    return mean[0] - v.center_x, mean[1] - v.center_y, mean[2] - v.center_z


@triton.jit
def to_view(offset, v):
    x = offset[0] * v.r00 + offset[1] * v.r01 + offset[2] * v.r02
    y = offset[0] * v.r10 + offset[1] * v.r11 + offset[2] * v.r12
    z = offset[0] * v.r20 + offset[1] * v.r21 + offset[2] * v.r22
    return x, y, z


@triton.jit
def image_axes(slope_x, slope_y, inverse_z, v):
    """A = J W, the derivative of the pixel by the world position, as two rows; and the clamped
    slopes."""
    slope_x = tl.minimum(tl.maximum(slope_x, v.slope_x_min), v.slope_x_max)
    slope_y = tl.minimum(tl.maximum(slope_y, v.slope_y_min), v.slope_y_max)
    first, second = image_rows(slope_x, slope_y, inverse_z, v)
    return first, second, slope_x, slope_y


@triton.jit
def image_rows(slope_x, slope_y, inverse_z, v):
    """The derivative of the pixel by the world position at given slopes x/z, y/z, as two rows."""
    jx, jy = inverse_z * v.fx, inverse_z * v.fy
    first = (
        jx * (v.r00 - slope_x * v.r20),
        jx * (v.r01 - slope_x * v.r21),
        jx * (v.r02 - slope_x * v.r22),
    )
    second = (
        jy * (v.r10 - slope_y * v.r20),
        jy * (v.r11 - slope_y * v.r21),
        jy * (v.r12 - slope_y * v.r22),
    )
    return first, second


@triton.jit
def spread(m0, m1):
    """xx, xy, yy of the covariance C = M M^T + BLUR I, for the rows of M; and a = yy / det C.

    1/a is the variance of x given y. det(M M^T) is the squared cross product of the rows. Dividing
    one row by sqrt(yy) first gives 1/a without cancellation and overflow.
    """
    xx, xy, yy = dot(m0, m0), dot(m0, m1), dot(m1, m1) + BLUR
    inverse = 1.0 / tl.sqrt(yy)
    n1 = (m1[0] * inverse, m1[1] * inverse, m1[2] * inverse)
    cross = (
        m0[1] * n1[2] - m0[2] * n1[1],
        m0[2] * n1[0] - m0[0] * n1[2],
        m0[0] * n1[1] - m0[1] * n1[0],
    )
    given = dot(cross, cross) + BLUR * (xx + yy) / yy
    return xx + BLUR, xy, yy, 1.0 / given


@triton.jit
def basis(direction, DEGREE: tl.constexpr):
    """The basis functions of degrees 1 to ``DEGREE`` at unit directions; ``DEGREE`` is at least
    1."""
    x, y, z = direction
    values = (y * -F1, z * F1, x * -F1)
    if DEGREE >= 2:
        xx, yy, zz = x * x, y * y, z * z
        quadratic = (x * y * D0, y * z * D1, (2 * zz - xx - yy) * D2, x * z * D3, (xx - yy) * D4)
        values = values + quadratic  # type: ignore[assignment]
        if DEGREE >= 3:
            cubic = (
                y * (3 * xx - yy) * T0,
                x * y * z * T1,
                y * (4 * zz - xx - yy) * T2,
                z * (2 * zz - 3 * xx - 3 * yy) * T3,
                x * (4 * zz - xx - yy) * T4,
                z * (xx - yy) * T5,
                x * (xx - 3 * yy) * T6,
            )
            values = values + cubic  # type: ignore[assignment]
    return values


@triton.jit
def _coefficients(sh_rest, index, k: tl.constexpr, mask):
    """The k-th coefficients of red, green and blue, counted from degree 1."""
    place = index * REST + 3 * k
    red = tl.load(sh_rest + place, mask=mask, other=0.0)
    green = tl.load(sh_rest + place + 1, mask=mask, other=0.0)
    blue = tl.load(sh_rest + place + 2, mask=mask, other=0.0)
    return red, green, blue


@triton.jit
def _add(sums, coefficients, factor):
    return (
        sums[0] + coefficients[0] * factor,
        sums[1] + coefficients[1] * factor,
        sums[2] + coefficients[2] * factor,
    )


@triton.jit
def colors(direction, dc, sh_rest, index, mask, DEGREE: tl.constexpr):
    """The colours SH + 0.5, not clamped, of the Gaussians ``index`` at unit directions, and their
    derivatives by x, y and z of the direction, not yet projected to the tangent of the unit sphere;
    each for red, green and blue.

    ``dc`` are the coefficients of degree 0.
    """
    x, y, z = direction
    rgb = (dc[0] * F0 + 0.5, dc[1] * F0 + 0.5, dc[2] * F0 + 0.5)
    zero = tl.zeros_like(x)
    by_x, by_y, by_z = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
    if DEGREE >= 1:
        values = basis(direction, DEGREE)
        c = _coefficients(sh_rest, index, 0, mask)
        rgb, by_y = _add(rgb, c, values[0]), _add(by_y, c, -F1)
        c = _coefficients(sh_rest, index, 1, mask)
        rgb, by_z = _add(rgb, c, values[1]), _add(by_z, c, F1)
        c = _coefficients(sh_rest, index, 2, mask)
        rgb, by_x = _add(rgb, c, values[2]), _add(by_x, c, -F1)
    if DEGREE >= 2:
        c = _coefficients(sh_rest, index, 3, mask)
        rgb, by_x, by_y = _add(rgb, c, values[3]), _add(by_x, c, D0 * y), _add(by_y, c, D0 * x)
        c = _coefficients(sh_rest, index, 4, mask)
        rgb, by_y, by_z = _add(rgb, c, values[4]), _add(by_y, c, D1 * z), _add(by_z, c, D1 * y)
        c = _coefficients(sh_rest, index, 5, mask)
        rgb, by_x = _add(rgb, c, values[5]), _add(by_x, c, -2 * D2 * x)
        by_y, by_z = _add(by_y, c, -2 * D2 * y), _add(by_z, c, 4 * D2 * z)
        c = _coefficients(sh_rest, index, 6, mask)
        rgb, by_x, by_z = _add(rgb, c, values[6]), _add(by_x, c, D3 * z), _add(by_z, c, D3 * x)
        c = _coefficients(sh_rest, index, 7, mask)
        rgb = _add(rgb, c, values[7])
        by_x = _add(by_x, c, 2 * D4 * x)
        by_y = _add(by_y, c, -2 * D4 * y)
    if DEGREE >= 3:
        xx, yy, zz = x * x, y * y, z * z
        xy, yz, xz = x * y, y * z, x * z
        c = _coefficients(sh_rest, index, 8, mask)
        rgb = _add(rgb, c, values[8])
        by_x = _add(by_x, c, 6 * T0 * xy)
        by_y = _add(by_y, c, 3 * T0 * (xx - yy))
        c = _coefficients(sh_rest, index, 9, mask)
        rgb, by_x = _add(rgb, c, values[9]), _add(by_x, c, T1 * yz)
        by_y, by_z = _add(by_y, c, T1 * xz), _add(by_z, c, T1 * xy)
        c = _coefficients(sh_rest, index, 10, mask)
        rgb, by_x = _add(rgb, c, values[10]), _add(by_x, c, -2 * T2 * xy)
        by_y, by_z = _add(by_y, c, T2 * (4 * zz - xx - 3 * yy)), _add(by_z, c, 8 * T2 * yz)
        c = _coefficients(sh_rest, index, 11, mask)
        rgb, by_x = _add(rgb, c, values[11]), _add(by_x, c, -6 * T3 * xz)
        by_y, by_z = _add(by_y, c, -6 * T3 * yz), _add(by_z, c, T3 * (6 * zz - 3 * xx - 3 * yy))
        c = _coefficients(sh_rest, index, 12, mask)
        rgb, by_x = _add(rgb, c, values[12]), _add(by_x, c, T4 * (4 * zz - 3 * xx - yy))
        by_y, by_z = _add(by_y, c, -2 * T4 * xy), _add(by_z, c, 8 * T4 * xz)
        c = _coefficients(sh_rest, index, 13, mask)
        rgb, by_x = _add(rgb, c, values[13]), _add(by_x, c, 2 * T5 * xz)
        by_y, by_z = _add(by_y, c, -2 * T5 * yz), _add(by_z, c, T5 * (xx - yy))
        c = _coefficients(sh_rest, index, 14, mask)
        rgb = _add(rgb, c, values[14])
        by_x = _add(by_x, c, 3 * T6 * (xx - yy))
        by_y = _add(by_y, c, -6 * T6 * xy)
    return rgb, by_x, by_y, by_z


@triton.jit
def store_gradients(direction, g_rgb, g_sh_rest, index, mask, DEGREE: tl.constexpr):
    """Store the gradients by the coefficients of degrees 1 to ``DEGREE``."""
    if DEGREE >= 1:
        values = basis(direction, DEGREE)
        for k in tl.static_range(0, (DEGREE + 1) * (DEGREE + 1) - 1):
            place = g_sh_rest + index * REST + 3 * k
            tl.store(place, values[k] * g_rgb[0], mask=mask)
            tl.store(place + 1, values[k] * g_rgb[1], mask=mask)
            tl.store(place + 2, values[k] * g_rgb[2], mask=mask)
