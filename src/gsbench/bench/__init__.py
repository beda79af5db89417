"""Time of a training step and its parts, and peak memory, with each rasterizer."""

from gsbench.bench.measure import run_bench

__all__ = ["run_bench"]
