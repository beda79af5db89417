"""The extra output ``splitting_matrix`` (`gsbench.raster.splitting`) of ``cpu``."""

from gsbench.raster.cpu.geometry import OF_VECTORS
from gsbench.raster.cpu.simd import scatter
from gsbench.system.jit import inlined

splitting_entries = OF_VECTORS.splitting_entries


@inlined
def scatter_splitting(g_extra, indices, d00, d01, d11, shear, rows):
    """Write the splitting matrices to ``g_extra`` [N, 9]; see `formulas.splitting_entries`."""
    xx, xy, xz, yy, yz, zz = splitting_entries(d00, d01, d11, shear, rows)
    scatter(g_extra, indices, 9, 0, xx)
    scatter(g_extra, indices, 9, 1, xy)
    scatter(g_extra, indices, 9, 2, xz)
    scatter(g_extra, indices, 9, 3, xy)
    scatter(g_extra, indices, 9, 4, yy)
    scatter(g_extra, indices, 9, 5, yz)
    scatter(g_extra, indices, 9, 6, xz)
    scatter(g_extra, indices, 9, 7, yz)
    scatter(g_extra, indices, 9, 8, zz)
