"""Costs of a training step with each rasterizer: times and their split, waits for a device, peak memory."""

from gsbench.bench.measure import run_bench

__all__ = ["run_bench"]
