"""Costs of a training step with each rasterizer: times and their split, waits for a device, peak memory."""

from gsbench.bench.run import run_bench

__all__ = ["run_bench"]
