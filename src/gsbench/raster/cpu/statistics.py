"""The statistics of adaptive density control, gathered in one pass over the Gaussians."""

import numpy as np

from gsbench.system.jit import kernel

ZERO = np.float32(0)


@kernel
def add_view(radii, gradient, gradient_sum, visible_count, max_radii):
    """Add one view to the statistics of the Gaussians that it shows; all arrays are [N].

    ``radii`` are int32 px, and ``gradient`` [N, 2] float32 is that by the projected means. Its
    length is rounded as by ``torch.linalg.vector_norm``: the second square is not rounded before it
    is added to the first. In float64, products of float32 are exact.
    """
    for k in range(len(radii)):  # without branches, so that LLVM makes vectors of it
        visible = radii[k] > 0
        first = np.float64(gradient[k, 0] * gradient[k, 0])
        second = np.float64(gradient[k, 1])
        length = np.sqrt(np.float32(first + second * second))
        gradient_sum[k] += length if visible else ZERO
        visible_count[k] += np.int32(visible)
        max_radii[k] = max(max_radii[k], radii[k])
