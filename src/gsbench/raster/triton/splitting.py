"""The extra output ``splitting_matrix`` (`gsbench.raster.splitting`) of ``triton``."""

from __future__ import annotations

import triton
import triton.language as tl

from gsbench.raster.triton.geometry import OF_LANES, store_or_zero

ENTRIES = tl.constexpr(9)  # of a matrix
splitting_entries = OF_LANES.splitting_entries


@triton.jit
def store_splitting(g_extra, index, d00, d01, d11, shear, rows, seen, inside):
    """Write the splitting matrices to ``g_extra`` [N, ENTRIES]; see `splitting_entries`."""
    xx, xy, xz, yy, yz, zz = splitting_entries(d00, d01, d11, shear, rows)
    place = g_extra + ENTRIES * index
    entries = (xx, xy, xz, xy, yy, yz, xz, yz, zz)
    for k in tl.static_range(9):
        store_or_zero(place + k, entries[k], seen, inside)
