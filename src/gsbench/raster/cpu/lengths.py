"""Lengths of vectors of two numbers, such as gradients by projected means."""

import numpy as np

from gsbench.system.jit import kernel


@kernel
def measure_lengths(vectors, lengths):
    """Write the lengths of ``vectors`` [N, 2] to ``lengths`` [N], both float32.

    They are rounded as by ``torch.linalg.vector_norm``: the second square is not rounded before it
    is added to the first. In float64, products of float32 are exact.
    """
    for k in range(len(vectors)):
        first = np.float64(vectors[k, 0] * vectors[k, 0])
        second = np.float64(vectors[k, 1])
        lengths[k] = np.sqrt(np.float32(first + second * second))
