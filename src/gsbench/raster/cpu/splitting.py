"""The extra output ``splitting_matrix`` (`gsbench.raster.splitting`) of ``cpu``."""

from gsbench.raster.cpu.geometry import mixed, plus
from gsbench.raster.cpu.simd import scatter
from gsbench.system.jit import inlined


@inlined
def scatter_splitting(g_extra, indices, d00, d01, d11, shear, rows):
    """Write the splitting matrices F^T U^T (D G D - h D) U F to ``g_extra`` [N, 9].

    F = ``rows`` is the derivative of the projected mean; ``d00``, ``d01`` and ``d11`` are the
    entries of D G D - h D. The second derivative of alpha by the projected mean is alpha
    (u u^T - C), with u = C (dx, dy) and the conic C = U^T D U. Its sum with weights h / alpha is
    U^T (D G D - h D) U.
    """
    r1 = rows[1]
    r0 = plus(rows[0], shear, r1)
    s0, s1 = mixed(d00, r0, d01, r1), mixed(d01, r0, d11, r1)
    # The matrix is symmetric: entries above the diagonal are written twice.
    xy = r0[0] * s0[1] + r1[0] * s1[1]
    xz = r0[0] * s0[2] + r1[0] * s1[2]
    yz = r0[1] * s0[2] + r1[1] * s1[2]
    scatter(g_extra, indices, 9, 0, r0[0] * s0[0] + r1[0] * s1[0])
    scatter(g_extra, indices, 9, 1, xy)
    scatter(g_extra, indices, 9, 2, xz)
    scatter(g_extra, indices, 9, 3, xy)
    scatter(g_extra, indices, 9, 4, r0[1] * s0[1] + r1[1] * s1[1])
    scatter(g_extra, indices, 9, 5, yz)
    scatter(g_extra, indices, 9, 6, xz)
    scatter(g_extra, indices, 9, 7, yz)
    scatter(g_extra, indices, 9, 8, r0[2] * s0[2] + r1[2] * s1[2])
