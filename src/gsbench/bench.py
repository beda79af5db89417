"""What one training step costs with each rasterizer: times, their split, and peak memory.

The synthetic scene has the statistics of a trained model (many small Gaussians, few large, flat, opacities near 0 or 1) and
is the same for one count on every machine.
"""

from __future__ import annotations
