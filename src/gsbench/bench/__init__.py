"""Costs of a training step with each rasterizer: times and their split, peak memory."""

from gsbench.bench.measure import run_bench

__all__ = ["run_bench"]
