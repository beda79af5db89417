"""Adam (Kingma and Ba 2015, algorithm 1) for rows of parameters, 16 numbers at a time.

The two factors of a step are those of `gsbench.gaussians.trainable.ParameterState.factors`.
"""

import numpy as np

from gsbench.gaussians.paper_values import ADAM_BETAS, ADAM_EPSILON
from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.simd import LANES, load, prefetch_far, square_root, store
from gsbench.system.jit import inlined, kernel

BETA1, BETA2 = (np.float32(beta) for beta in ADAM_BETAS)
REST1, REST2 = (np.float32(1 - beta) for beta in ADAM_BETAS)
EPSILON = np.float32(ADAM_EPSILON)
AHEAD = 4096  # numbers ahead that are prefetched


@inlined
def _move(values, first, second, gradients, place, source, factor, root):
    """Step the 16 numbers from ``place`` by the gradients from ``source``."""
    prefetch_far(first, place + AHEAD)
    prefetch_far(second, place + AHEAD)
    prefetch_far(values, place + AHEAD)
    gradient = load(gradients, source)
    mean = load(first, place) * BETA1 + gradient * REST1
    square = load(second, place) * BETA2 + gradient * gradient * REST2
    store(first, place, mean)
    store(second, place, square)
    change = mean * factor / (square_root(square) * root + EPSILON)
    store(values, place, load(values, place) - change)


@inlined
def step_rows(values, first, second, gradients, begin, end, own, active, factor, root, spare):
    """Step the rows ``begin`` to before ``end`` of ``values`` [N, C]; ``first``, ``second`` alike.

    Row ``begin`` has its gradient in row ``own`` of ``gradients``. Gradients are 0 from column
    ``active`` on, where values and moments do not change: a vector may reach beyond it. ``spare``
    [64] is scratch.
    """
    width = values.shape[1]
    if active < width:
        for row in range(begin, end):
            source = (row - begin + own) * width
            for column in range(0, active, LANES):
                place = row * width + column
                _move(values, first, second, gradients, place, source + column, factor, root)
        return
    place, past, shift = begin * width, end * width, (own - begin) * width
    while place + LANES <= past:
        _move(values, first, second, gradients, place, place + shift, factor, root)
        place += LANES
    if place < past:
        # Fewer than 16 numbers: a vector would step those behind them, too.
        a, b, c, d = spare[:LANES], spare[LANES:], spare[2 * LANES :], spare[3 * LANES :]
        for k in range(past - place):
            row, column = (place + k) // width, (place + k) % width
            a[k], b[k], c[k] = values[row, column], first[row, column], second[row, column]
            d[k] = gradients[row - begin + own, column]
        _move(a, b, c, d, 0, 0, factor, root)
        for k in range(past - place):
            row, column = (place + k) // width, (place + k) % width
            values[row, column], first[row, column], second[row, column] = a[k], b[k], c[k]


@kernel
def adam_rows(first, past, spare, values, means, squares, gradients, active, factor, root):
    """`step_rows` for the shards ``first`` to ``past`` of arrays [N, C]; ``spare`` [shards, 64]."""
    begin, end = len(values) * first // len(spare), len(values) * past // len(spare)
    own = spare[first]
    step_rows(values, means, squares, gradients, begin, end, begin, active, factor, root, own)


@inlined
def step_all(gaussians, adam, gradients, begin, end, own, spare):
    """Step the Gaussians ``begin`` to before ``end``; ``gradients`` has these from row ``own``."""
    for k in range(len(gaussians)):
        values = gaussians[k]
        active = adam.active if k == at.SH_REST else values.shape[1]
        a, b = adam.factors[k, 0], adam.factors[k, 1]
        means, squares, own_rows = adam.first[k], adam.second[k], gradients[k]
        step_rows(values, means, squares, own_rows, begin, end, own, active, a, b, spare)
