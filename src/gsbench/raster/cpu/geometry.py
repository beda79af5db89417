"""The geometry of projection for 16 Gaussians at a time, in float32, shared by the forward and the backward kernel.

Matrices are tuples of rows, vectors tuples. Nothing here subtracts large numbers: see ``spread``.
"""

from __future__ import annotations

import math
from typing import Any

from gsbench.raster.base import CONSTANTS
from gsbench.raster.cpu.simd import exp2, gather, maximum, minimum, square_root
from gsbench.system.jit import inlined

LOG2_E = 1.0 / math.log(2.0)
BLUR = CONSTANTS.blur
MAX_LOG2 = 126.0  # beyond, exp2 is undefined; a scale of 2^126 has a variance that is not finite, and is culled


@inlined
def exponential(x: Any) -> Any:
    return exp2(maximum(minimum(x * LOG2_E, MAX_LOG2), -MAX_LOG2))


@inlined
def rotation_matrix(w: Any, x: Any, y: Any, z: Any) -> Any:
    """The rows of the rotation matrix of a unit quaternion."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@inlined
def from_camera(mean: Any, v: Any) -> Any:
    """The vector from the camera centre to the mean, in world axes.

    Everything goes through this difference: rotating it loses no digits however far the scene is from its origin.
    """
    return mean[0] - v.center_x, mean[1] - v.center_y, mean[2] - v.center_z


@inlined
def to_view(offset: Any, v: Any) -> Any:
    x = offset[0] * v.r00 + offset[1] * v.r01 + offset[2] * v.r02
    y = offset[0] * v.r10 + offset[1] * v.r11 + offset[2] * v.r12
    z = offset[0] * v.r20 + offset[1] * v.r21 + offset[2] * v.r22
    return x, y, z


@inlined
def image_axes(slope_x: Any, slope_y: Any, inverse_z: Any, v: Any) -> Any:
    """A = J W, the derivative of the pixel with respect to the world position, as two rows; the clamped slopes."""
    slope_x = minimum(maximum(slope_x, v.slope_x_min), v.slope_x_max)
    slope_y = minimum(maximum(slope_y, v.slope_y_min), v.slope_y_max)
    first, second = image_rows(slope_x, slope_y, inverse_z, v)
    return first, second, slope_x, slope_y


@inlined
def image_rows(slope_x: Any, slope_y: Any, inverse_z: Any, v: Any) -> Any:
    """The derivative of the pixel with respect to the world position at x/z, y/z = the slopes, as two rows."""
    jx, jy = inverse_z * v.fx, inverse_z * v.fy
    first = (jx * (v.r00 - slope_x * v.r20), jx * (v.r01 - slope_x * v.r21), jx * (v.r02 - slope_x * v.r22))
    second = (jy * (v.r10 - slope_y * v.r20), jy * (v.r11 - slope_y * v.r21), jy * (v.r12 - slope_y * v.r22))
    return first, second


@inlined
def dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def times(row: Any, matrix: Any) -> Any:
    """``row`` [3] times ``matrix`` [3, 3]."""
    return (
        row[0] * matrix[0][0] + row[1] * matrix[1][0] + row[2] * matrix[2][0],
        row[0] * matrix[0][1] + row[1] * matrix[1][1] + row[2] * matrix[2][1],
        row[0] * matrix[0][2] + row[1] * matrix[1][2] + row[2] * matrix[2][2],
    )


@inlined
def scaled(row: Any, scales: Any) -> Any:
    return row[0] * scales[0], row[1] * scales[1], row[2] * scales[2]


@inlined
def gather_vectors(array: Any, indices: Any) -> Any:
    return gather(array, indices, 3, 0), gather(array, indices, 3, 1), gather(array, indices, 3, 2)


@inlined
def gather_quaternions(quaternions: Any, indices: Any) -> Any:
    """The unit quaternions, and the inverse norm and squared norm of what is stored."""
    w, x = gather(quaternions, indices, 4, 0), gather(quaternions, indices, 4, 1)
    y, z = gather(quaternions, indices, 4, 2), gather(quaternions, indices, 4, 3)
    squared = w * w + x * x + y * y + z * z
    inverse = 1 / square_root(squared)
    return (w * inverse, x * inverse, y * inverse, z * inverse), inverse, squared


@inlined
def spread(m0: Any, m1: Any) -> Any:
    """Spread of the rows of M: xx, xy, yy of the covariance C = M M^T + BLUR I, and a = yy / det C.

    1/a is the variance of x given y. det(M M^T) is the squared cross product of the rows; dividing a row by the square
    root of yy first gives 1/a without cancellation and without overflow.
    """
    xx, xy, yy = dot(m0, m0), dot(m0, m1), dot(m1, m1) + BLUR
    inverse = 1 / square_root(yy)
    n1 = (m1[0] * inverse, m1[1] * inverse, m1[2] * inverse)
    cross = (m0[1] * n1[2] - m0[2] * n1[1], m0[2] * n1[0] - m0[0] * n1[2], m0[0] * n1[1] - m0[1] * n1[0])
    given = dot(cross, cross) + BLUR * (xx + yy) / yy
    return xx + BLUR, xy, yy, 1 / given


@inlined
def normalized(offset: Any) -> Any:
    """Scale ``offset`` to length 1; with the inverse of its length."""
    inverse = 1 / square_root(dot(offset, offset))
    return scaled(offset, (inverse, inverse, inverse)), inverse
