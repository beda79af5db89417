"""The rasterizer for GPUs, in Triton kernels: needs nothing but torch and the Triton that torch brings along."""
