"""The rasterizer for GPUs in Triton kernels (`TritonRasterizer`): needs nothing but torch and the Triton it comes with."""

from gsbench.raster.triton.executor import TritonRasterizer

__all__ = ["TritonRasterizer"]
