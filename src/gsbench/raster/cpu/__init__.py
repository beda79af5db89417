"""``raster=cpu``: the rasterizer compiled by numba for the CPU at hand."""

from gsbench.raster.cpu.executor import CpuRasterizer

__all__ = ["CpuRasterizer"]
