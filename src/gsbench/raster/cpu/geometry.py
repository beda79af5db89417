"""Access to 16 Gaussians at a time, their spherical harmonics, and the formulas for vectors.

The harmonics of 16 Gaussians are a 16x16 matrix with one row per basis function. The
kernels transpose it into one row per Gaussian and multiply that by the coefficients.
"""

from typing import Any

import numpy as np

from gsbench.gaussians.model import C0, C1, C2, C3
from gsbench.raster import formulas
from gsbench.raster.cpu.shuffle import transpose
from gsbench.raster.cpu.simd import (
    LANES,
    ceil,
    exp2,
    floor,
    gather_fours,
    load,
    maximum,
    minimum,
    select,
    splat,
    square_root,
    store,
)
from gsbench.system.jit import inlined

LOG2_E = formulas.LOG2_E
# Beyond this, exp2 is undefined. The variance of a scale of 2^126 is not finite, so such a Gaussian
# is culled.
MAX_LOG2 = 126.0
F0, F1 = np.float32(C0), np.float32(C1)
D0, D1, D2, D3, D4 = (np.float32(value) for value in C2)
T0, T1, T2, T3, T4, T5, T6 = (np.float32(value) for value in C3)
TWO, THREE, FOUR, SIX, EIGHT = (np.float32(value) for value in (2, 3, 4, 6, 8))
ZERO = np.float32(0)
MATRIX = LANES * LANES


OF_VECTORS = formulas.compiled(
    inlined,
    select=select,
    minimum=minimum,
    maximum=maximum,
    square_root=square_root,
    floor=floor,
    ceil=ceil,
)
dot, stretched = OF_VECTORS.dot, OF_VECTORS.stretched


def __getattr__(name: str) -> Any:
    """The other formulas, so that kernels import them from here."""
    return getattr(OF_VECTORS, name)


@inlined
def exponential(x):
    return exp2(maximum(minimum(x * LOG2_E, MAX_LOG2), -MAX_LOG2))


@inlined
def exponentials(row):
    return exponential(row[0]), exponential(row[1]), exponential(row[2])


@inlined
def gather_quaternions(quaternions, indices):
    """The unit quaternions, and the inverse norm and the squared norm of the stored ones."""
    w, x, y, z = gather_fours(quaternions, indices)
    squared = w * w + x * x + y * y + z * z
    inverse = 1 / square_root(squared)
    return (w * inverse, x * inverse, y * inverse, z * inverse), inverse, squared


@inlined
def normalized(offset):
    """``offset`` scaled to length 1, and the inverse of its length."""
    inverse = 1 / square_root(dot(offset, offset))
    return stretched(offset, inverse), inverse


@inlined
def fill_basis(degree, direction, matrix):
    """Write basis function k + 1 at the unit directions to column k of ``matrix`` [16 * 16].

    Each row is one Gaussian. The columns of functions above ``degree`` and the last column are
    zero.
    """
    x, y, z = direction
    for k in range((degree + 1) * (degree + 1) - 1, LANES):
        store(matrix, k * LANES, splat(ZERO))
    if degree >= 1:
        store(matrix, 0, -F1 * y)
        store(matrix, LANES, F1 * z)
        store(matrix, 2 * LANES, -F1 * x)
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        store(matrix, 3 * LANES, D0 * x * y)
        store(matrix, 4 * LANES, D1 * y * z)
        store(matrix, 5 * LANES, D2 * (TWO * zz - xx - yy))
        store(matrix, 6 * LANES, D3 * x * z)
        store(matrix, 7 * LANES, D4 * (xx - yy))
        if degree >= 3:
            store(matrix, 8 * LANES, T0 * y * (THREE * xx - yy))
            store(matrix, 9 * LANES, T1 * x * y * z)
            store(matrix, 10 * LANES, T2 * y * (FOUR * zz - xx - yy))
            store(matrix, 11 * LANES, T3 * z * (TWO * zz - THREE * xx - THREE * yy))
            store(matrix, 12 * LANES, T4 * x * (FOUR * zz - xx - yy))
            store(matrix, 13 * LANES, T5 * z * (xx - yy))
            store(matrix, 14 * LANES, T6 * x * (xx - THREE * yy))
    transpose(matrix, 0)


@inlined
def direction_gradient(degree, direction, matrix):
    """The gradient of ``sum_k g[k] basis[k + 1]`` by the direction (x, y, z).

    It is not yet projected to the tangent plane of the unit sphere. ``matrix`` [16 * 16] has g of
    one Gaussian in each row; this function transposes it.
    """
    x, y, z = direction
    gx, gy, gz = splat(ZERO), splat(ZERO), splat(ZERO)
    if degree >= 1:
        transpose(matrix, 0)
        gx = -F1 * load(matrix, 2 * LANES)
        gy = -F1 * load(matrix, 0)
        gz = F1 * load(matrix, LANES)
    if degree >= 2:
        g_xy, g_yz, g_zz = load(matrix, 3 * LANES), load(matrix, 4 * LANES), load(matrix, 5 * LANES)
        g_xz, g_xx_yy = load(matrix, 6 * LANES), load(matrix, 7 * LANES)
        gx += D0 * y * g_xy - TWO * D2 * x * g_zz + D3 * z * g_xz + TWO * D4 * x * g_xx_yy
        gy += D0 * x * g_xy + D1 * z * g_yz - TWO * D2 * y * g_zz - TWO * D4 * y * g_xx_yy
        gz += D1 * y * g_yz + FOUR * D2 * z * g_zz + D3 * x * g_xz
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        xy, xz, yz = x * y, x * z, y * z
        g9, g10, g11 = load(matrix, 8 * LANES), load(matrix, 9 * LANES), load(matrix, 10 * LANES)
        g12, g13, g14 = load(matrix, 11 * LANES), load(matrix, 12 * LANES), load(matrix, 13 * LANES)
        g15 = load(matrix, 14 * LANES)
        gx += (
            SIX * T0 * xy * g9
            + T1 * yz * g10
            - TWO * T2 * xy * g11
            - SIX * T3 * xz * g12
            + T4 * (FOUR * zz - THREE * xx - yy) * g13
            + TWO * T5 * xz * g14
            + THREE * T6 * (xx - yy) * g15
        )
        gy += (
            THREE * T0 * (xx - yy) * g9
            + T1 * xz * g10
            + T2 * (FOUR * zz - xx - THREE * yy) * g11
            - SIX * T3 * yz * g12
            - TWO * T4 * xy * g13
            - TWO * T5 * yz * g14
            - SIX * T6 * xy * g15
        )
        gz += (
            T1 * xy * g10
            + EIGHT * T2 * yz * g11
            + T3 * (SIX * zz - THREE * xx - THREE * yy) * g12
            + EIGHT * T4 * xz * g13
            + T5 * (xx - yy) * g14
        )
    return gx, gy, gz
