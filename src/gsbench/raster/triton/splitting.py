"""The extra output ``splitting_matrix`` (`gsbench.raster.splitting`) of ``triton``."""

from __future__ import annotations

import triton
import triton.language as tl

from gsbench.raster.triton.geometry import mixed, plus, store_or_zero

ENTRIES = tl.constexpr(9)  # of a matrix


@triton.jit
def store_splitting(g_extra, index, d00, d01, d11, shear, rows, seen, inside):
    """Write the splitting matrices F^T U^T (D G D - h D) U F to ``g_extra`` [N, ENTRIES].

    See `gsbench.raster.cpu.splitting.scatter_splitting`.
    """
    place = g_extra + ENTRIES * index
    r1 = rows[1]
    r0 = plus(rows[0], shear, r1)
    s0, s1 = mixed(d00, r0, d01, r1), mixed(d01, r0, d11, r1)
    # The matrix is symmetric: entries above the diagonal are written twice.
    xy = r0[0] * s0[1] + r1[0] * s1[1]
    xz = r0[0] * s0[2] + r1[0] * s1[2]
    yz = r0[1] * s0[2] + r1[1] * s1[2]
    store_or_zero(place, r0[0] * s0[0] + r1[0] * s1[0], seen, inside)
    store_or_zero(place + 1, xy, seen, inside)
    store_or_zero(place + 2, xz, seen, inside)
    store_or_zero(place + 3, xy, seen, inside)
    store_or_zero(place + 4, r0[1] * s0[1] + r1[1] * s1[1], seen, inside)
    store_or_zero(place + 5, yz, seen, inside)
    store_or_zero(place + 6, xz, seen, inside)
    store_or_zero(place + 7, yz, seen, inside)
    store_or_zero(place + 8, r0[2] * s0[2] + r1[2] * s1[2], seen, inside)
