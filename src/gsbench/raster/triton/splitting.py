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
    # The matrix is symmetric, bit for bit: entries below the diagonal repeat those above it.
    for i in tl.static_range(3):
        for j in tl.static_range(3):
            entry = r0[i] * s0[j] + r1[i] * s1[j] if i <= j else r0[j] * s0[i] + r1[j] * s1[i]
            store_or_zero(place + 3 * i + j, entry, seen, inside)
