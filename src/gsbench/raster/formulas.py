"""Formulas of the projection and of its gradients, written once for all compilers.

Their arguments are numbers, arrays, or the vectors of a compiler; a vector [3] is a tuple, and a
matrix a tuple of rows. As they stand here, they compute with numpy. `compiled` makes the same
functions for numba or Triton. No formula subtracts large numbers (see `spread`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np

from gsbench.raster.base import CONSTANTS

BLUR: Any = CONSTANTS.blur
EIGENVALUE_FLOOR: Any = CONSTANTS.eigenvalue_floor
SIGMA_EXTENT: Any = CONSTANTS.sigma_extent
MAX_RADIUS: Any = CONSTANTS.max_radius
CONTOUR_MARGIN: Any = CONSTANTS.contour_margin
LOG2_E: Any = 1.0 / math.log(2.0)
select: Any = np.where
minimum: Any = np.minimum
maximum: Any = np.maximum
square_root: Any = np.sqrt
floor: Any = np.floor
ceil: Any = np.ceil


def compiled(
    compiler: Callable[..., Any], constant: Callable[[float], Any] = float, **operations: Any
) -> SimpleNamespace:
    """All formulas, compiled by ``compiler``, with ``operations`` in place of those of numpy.

    ``constant`` makes a constant of the compiler. The functions call each other by name, so they
    share one set of global names.
    """
    numbers = {name: value for name, value in globals().items() if isinstance(value, float)}
    constants = {name: constant(value) for name, value in numbers.items()}
    formulas = [f for f in globals().values() if getattr(f, "__module__", None) == __name__]
    names: dict[str, Any] = {"__name__": __name__, **constants, **operations}
    made = SimpleNamespace()
    for formula in formulas:
        if isinstance(formula, FunctionType) and formula is not compiled:
            names[formula.__name__] = compiler(FunctionType(formula.__code__, names))
            setattr(made, formula.__name__, names[formula.__name__])
    return made


# mypy: disable-error-code="no-untyped-def"


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def times(row, matrix):
    """``row`` [3] times ``matrix`` [3, 3]."""
    return (
        row[0] * matrix[0][0] + row[1] * matrix[1][0] + row[2] * matrix[2][0],
        row[0] * matrix[0][1] + row[1] * matrix[1][1] + row[2] * matrix[2][1],
        row[0] * matrix[0][2] + row[1] * matrix[1][2] + row[2] * matrix[2][2],
    )


def through(matrix, column):
    """``matrix`` [3, 3] times ``column`` [3]."""
    return dot(column, matrix[0]), dot(column, matrix[1]), dot(column, matrix[2])


def scaled(row, scales):
    return row[0] * scales[0], row[1] * scales[1], row[2] * scales[2]


def stretched(row, factor):
    return row[0] * factor, row[1] * factor, row[2] * factor


def plus(a, factor, b):
    """``a + factor * b`` of two vectors [3]."""
    return a[0] + b[0] * factor, a[1] + b[1] * factor, a[2] + b[2] * factor


def minus(a, factor, b):
    """``a - factor * b``: for Triton, ``-factor`` would be an instruction of its own."""
    return a[0] - factor * b[0], a[1] - factor * b[1], a[2] - factor * b[2]


def mixed(p, a, q, b):
    """``p * a + q * b`` of two vectors [3]."""
    return p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2]


def rotation_matrix(quaternion):
    """The rows of the rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def view_axes(v):
    """The rows of the camera's rotation W, from world to view."""
    return (v.r00, v.r01, v.r02), (v.r10, v.r11, v.r12), (v.r20, v.r21, v.r22)


def from_camera(mean, v):
    """The vector from the camera centre to the mean, in world axes.

    The difference is computed before the rotation, so no digits are lost even if the scene is far
    from the origin.
    """
    return mean[0] - v.center_x, mean[1] - v.center_y, mean[2] - v.center_z


def clamped_slopes(slope_x, slope_y, v):
    """x/z and y/z within the limits of the Jacobian (`raster.base.slope_limits`)."""
    slope_x = minimum(maximum(slope_x, v.slope_x_min), v.slope_x_max)
    return slope_x, minimum(maximum(slope_y, v.slope_y_min), v.slope_y_max)


def image_rows(slope_x, slope_y, inverse_z, v):
    """A = J W, the derivative of the pixel by the world position, as two rows.

    J is the derivative of x fx / z and y fy / z by the position in view space, at the slopes x/z
    and y/z (EWA splatting, Zwicker et al. 2001; computeCov2D in 3DGS).
    """
    right, down, ahead = view_axes(v)
    first = stretched(minus(right, slope_x, ahead), inverse_z * v.fx)
    return first, stretched(minus(down, slope_y, ahead), inverse_z * v.fy)


def spread(m0, m1):
    """xx, xy, yy of the covariance C = M M^T + BLUR I, for the rows of M; and a = yy / det C.

    1/a is the variance of x given y. det(M M^T) is the squared cross product of the rows. Dividing
    one row by sqrt(yy) first gives 1/a without cancellation and overflow.
    """
    xx, xy, yy = dot(m0, m0), dot(m0, m1), dot(m1, m1) + BLUR
    inverse = 1.0 / square_root(yy)
    n1 = stretched(m1, inverse)
    cross = (
        m0[1] * n1[2] - m0[2] * n1[1],
        m0[2] * n1[0] - m0[0] * n1[2],
        m0[0] * n1[1] - m0[1] * n1[0],
    )
    given = dot(cross, cross) + BLUR * (xx + yy) / yy
    return xx + BLUR, xy, yy, 1.0 / given


def image_axes(free_x, free_y, inverse_z, quaternion, v):
    """R, and the rows of N = A R; ``free_x`` and ``free_y`` are x/z and y/z without limits.

    With the scales S, the covariance on the image is M M^T + BLUR I, M = N S (3DGS eq. 5 and 6).
    """
    slope_x, slope_y = clamped_slopes(free_x, free_y, v)
    axis_x, axis_y = image_rows(slope_x, slope_y, inverse_z, v)
    matrix = rotation_matrix(quaternion)
    return matrix, times(axis_x, matrix), times(axis_y, matrix)


def radius_of(xx, xy, yy):
    """ceil(3 sqrt(largest eigenvalue)), px, as preprocessCUDA of 3DGS computes it.

    The discriminant (trace / 2)^2 - det is written as a sum of squares, so it is never negative.
    """
    half = (xx - yy) * 0.5
    largest = (xx + yy) * 0.5 + square_root(maximum(half * half + xy * xy, EIGENVALUE_FLOOR))
    return minimum(ceil(square_root(largest) * SIGMA_EXTENT), MAX_RADIUS)


def tile_range(low, high, tiles, size):
    """First and past-the-last tile of ``size`` px for the pixels ``low`` to ``high`` - 1."""
    first = floor(minimum(maximum(low * (1.0 / size), 0.0), tiles))
    return first, floor(minimum(maximum((high + (size - 1)) * (1.0 / size), 0.0), tiles))


def contour_range(center, half, tiles, size):
    """The tiles of the pixels within ``half`` px of ``center``, with a margin for rounding."""
    half = half * (1 + CONTOUR_MARGIN) + CONTOUR_MARGIN
    return tile_range(ceil(center - half), floor(center + half) + 1.0, tiles, size)


def record_entries(column, row, form, log2_opacity, rgb):
    """The first nine entries of a record (an executor's `layout`).

    ``form`` are the three that give log2(alpha) by the place.
    """
    red, green, blue = maximum(0.0, rgb[0]), maximum(0.0, rgb[1]), maximum(0.0, rgb[2])
    return column, row, form[0], form[1], form[2], log2_opacity, red, green, blue


def covariance_gradients(q00, q01, q11, n0, n1, shear, scales):
    """Gradients by the log scales, by small turns, and by the rows of A = J W, through C.

    C = M M^T + BLUR I with M = N S and N = A R. d loss / d M = U^T Q U M with Q = D G D, D =
    diag(a, e), U = [[1, shear], [0, 1]] and G the second moments of h over (t, dy). For a needle
    the first row of U M is small, so U N is computed first, before large numbers can cancel. The
    gradients by the rows of A are in the Gaussian's own axes.
    """
    u0 = plus(n0, shear, n1)
    g0, g1 = mixed(q00, u0, q01, n1), mixed(q01, u0, q11, n1)
    variances = scaled(scales, scales)
    along = (
        u0[0] * g0[0] + n1[0] * g1[0],
        u0[1] * g0[1] + n1[1] * g1[1],
        u0[2] * g0[2] + n1[2] * g1[2],
    )
    # Rotation by small angles w about the Gaussian's own axes changes R S^2 R^T by a commutator, so
    # the gradient by w has differences of variances as factors. Computing these differences first,
    # as products, makes the gradient of a sphere exactly 0; otherwise rounding errors would remain,
    # which Adam scales to full steps.
    turn = (
        (u0[1] * g0[2] + n1[1] * g1[2]) * ((scales[1] - scales[2]) * (scales[1] + scales[2])),
        (u0[2] * g0[0] + n1[2] * g1[0]) * ((scales[2] - scales[0]) * (scales[2] + scales[0])),
        (u0[0] * g0[1] + n1[0] * g1[1]) * ((scales[0] - scales[1]) * (scales[0] + scales[1])),
    )
    s0 = scaled(g0, variances)
    return scaled(along, variances), turn, s0, plus(scaled(g1, variances), shear, s0)


def quaternion_gradient(quaternion, turn, twice):
    """The gradient by the stored quaternion q, which changes by q (0, w) / 2.

    ``turn`` is the gradient by w, ``twice`` is two over the norm of the stored quaternion.
    """
    qw, qx, qy, qz = quaternion
    w_x, w_y, w_z = turn
    return (
        -(qx * w_x + qy * w_y + qz * w_z) * twice,
        (qw * w_x + qy * w_z - qz * w_y) * twice,
        (qw * w_y + qz * w_x - qx * w_z) * twice,
        (qw * w_z + qx * w_y - qy * w_x) * twice,
    )


def position_gradient(a0, a1, g_column, g_row, free_x, free_y, inverse_z, v):
    """The gradient by the mean, in world axes, through the covariance and the place on the image.

    ``a0`` and ``a1`` are the gradients by the rows of A = J W. From them follow those by the
    entries of J, then by the position in view space, then by the position in the world.
    """
    right, down, ahead = view_axes(v)
    slope_x, slope_y = clamped_slopes(free_x, free_y, v)
    j00, j02, j11, j12 = dot(a0, right), dot(a0, ahead), dot(a1, down), dot(a1, ahead)
    fx_z, fy_z = inverse_z * v.fx, inverse_z * v.fy
    # The clamp of a slope passes the gradient only within the limits.
    g_slope_x = select((free_x >= v.slope_x_min) & (free_x <= v.slope_x_max), -fx_z * j02, 0.0)
    g_slope_y = select((free_y >= v.slope_y_min) & (free_y <= v.slope_y_max), -fy_z * j12, 0.0)
    view_x = g_column * fx_z + g_slope_x * inverse_z
    view_y = g_row * fy_z + g_slope_y * inverse_z
    by_focal = fx_z * (j00 - slope_x * j02) + fy_z * (j11 - slope_y * j12)
    view_z = -(by_focal * inverse_z + view_x * free_x + view_y * free_y)
    return times((view_x, view_y, view_z), (right, down, ahead))


def splitting_entries(d00, d01, d11, shear, rows):
    """The splitting matrix F^T U^T (D G D - h D) U F, row by row.

    F = ``rows`` is the derivative of the projected mean; ``d00``, ``d01`` and ``d11`` are the
    entries of D G D - h D. The second derivative of alpha by the projected mean is alpha
    (u u^T - C), with u = C (dx, dy) and the conic C = U^T D U. Its sum with weights h / alpha is
    U^T (D G D - h D) U.
    """
    r1 = rows[1]
    r0 = plus(rows[0], shear, r1)
    s0, s1 = mixed(d00, r0, d01, r1), mixed(d01, r0, d11, r1)
    xy, xz, yz = (
        r0[0] * s0[1] + r1[0] * s1[1],
        r0[0] * s0[2] + r1[0] * s1[2],
        r0[1] * s0[2] + r1[1] * s1[2],
    )
    xx, yy = r0[0] * s0[0] + r1[0] * s1[0], r0[1] * s0[1] + r1[1] * s1[1]
    return xx, xy, xz, xy, yy, yz, xz, yz, r0[2] * s0[2] + r1[2] * s1[2]
