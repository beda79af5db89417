"""The geometry of projection, shared by the forward and the backward kernel; float32, a lane a Gaussian.

Matrices are tuples of rows, vectors tuples. Nothing here subtracts large numbers: see ``spread``.
"""

from __future__ import annotations

import triton
import triton.language as tl

from gsbench.raster.base import CONSTANTS

BLUR = tl.constexpr(CONSTANTS.blur)


@triton.jit
def load_vector(array, index, mask):
    """Three numbers of each row ``index`` of an array [N, 3]; 0 outside ``mask``."""
    place = array + 3 * index
    return (
        tl.load(place, mask=mask, other=0.0),
        tl.load(place + 1, mask=mask, other=0.0),
        tl.load(place + 2, mask=mask, other=0.0),
    )


@triton.jit
def load_quaternion(quaternions, index, mask):
    """The unit quaternions (w, x, y, z), and the inverse norm and squared norm of what is stored."""
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

    Everything goes through this difference: rotating it loses no digits however far the scene is from its origin.
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
    """A = J W, the derivative of the pixel with respect to the world position, as two rows; the clamped slopes."""
    slope_x = tl.minimum(tl.maximum(slope_x, v.slope_x_min), v.slope_x_max)
    slope_y = tl.minimum(tl.maximum(slope_y, v.slope_y_min), v.slope_y_max)
    first, second = image_rows(slope_x, slope_y, inverse_z, v)
    return first, second, slope_x, slope_y


@triton.jit
def image_rows(slope_x, slope_y, inverse_z, v):
    """The derivative of the pixel with respect to the world position at x/z, y/z = the slopes, as two rows."""
    jx, jy = inverse_z * v.fx, inverse_z * v.fy
    first = (jx * (v.r00 - slope_x * v.r20), jx * (v.r01 - slope_x * v.r21), jx * (v.r02 - slope_x * v.r22))
    second = (jy * (v.r10 - slope_y * v.r20), jy * (v.r11 - slope_y * v.r21), jy * (v.r12 - slope_y * v.r22))
    return first, second


@triton.jit
def spread(m0, m1):
    """The covariance C = M M^T + blur I of the rows of M, as xx, xy, yy, and a = yy / det C.

    1/a is the variance of x given y. det(M M^T) is the squared cross product of the rows; dividing a row by the square
    root of yy first gives 1/a without cancellation and without overflow.
    """
    xx, xy, yy = dot(m0, m0), dot(m0, m1), dot(m1, m1) + BLUR
    inverse = 1.0 / tl.sqrt(yy)
    n1 = (m1[0] * inverse, m1[1] * inverse, m1[2] * inverse)
    cross = (m0[1] * n1[2] - m0[2] * n1[1], m0[2] * n1[0] - m0[0] * n1[2], m0[0] * n1[1] - m0[1] * n1[0])
    given = dot(cross, cross) + BLUR * (xx + yy) / yy
    return xx + BLUR, xy, yy, 1.0 / given
