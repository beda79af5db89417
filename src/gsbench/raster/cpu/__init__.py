"""``raster=cpu``: the rasterizer compiled by numba for the CPU at hand."""

import gsbench.system.jit  # noqa: F401 - before any module here imports numba: it is loaded with care there
from gsbench.raster.cpu.executor import CpuRasterizer

__all__ = ["CpuRasterizer"]
