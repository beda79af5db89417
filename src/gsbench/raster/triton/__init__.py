"""``raster=triton``: the rasterizer for GPUs.

It needs only torch and the Triton that torch installs.
"""
