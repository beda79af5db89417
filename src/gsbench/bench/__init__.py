"""Time of a training step and its parts, and peak memory, with each rasterizer."""
