"""Arithmetic of vectors [3] and matrices, as tuples: the source that both numba and Triton compile.

Each function is complete in itself: neither compiler follows a call to a plain function.
"""


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def times(row, matrix):
    """``row`` [3] times ``matrix`` [3, 3]."""
    return (
        row[0] * matrix[0][0] + row[1] * matrix[1][0] + row[2] * matrix[2][0],
        row[0] * matrix[0][1] + row[1] * matrix[1][1] + row[2] * matrix[2][1],
        row[0] * matrix[0][2] + row[1] * matrix[1][2] + row[2] * matrix[2][2],
    )


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

    It is computed first: rotating the difference loses no digits, even if the scene is far from the
    origin.
    """
    return mean[0] - v.center_x, mean[1] - v.center_y, mean[2] - v.center_z
