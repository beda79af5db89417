"""``raster=cpu``: the rasterizer compiled by numba for the present CPU."""

import gsbench.system.jit  # noqa: F401 - first: it loads numba safely, before a module here does
from gsbench.raster.cpu.executor import CpuRasterizer

__all__ = ["CpuRasterizer"]
