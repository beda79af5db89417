"""The photometric loss compiled for the CPU: a fused forward pass and a hand-written gradient.

Images stay interleaved [H, W, 3]: a row is 3 W numbers, and horizontal neighbours are 3 numbers
apart. So one vector holds 16 adjacent numbers of all channels. Each row is filtered horizontally
once, into a ring buffer of 11 rows, which are then filtered vertically. Statistics of the target
are computed again in each step, so views need no further memory.
"""

import numpy as np
import torch
from torch import Tensor

from gsbench.eval.ssim import C1, C2, WINDOW_RADIUS, window
from gsbench.raster.cpu.simd import (
    LANES,
    absolute,
    fma,
    lane_sums,
    load,
    select,
    splat,
    store,
)
from gsbench.raster.cpu.workspace import ArenaPool, ShardRunner, TensorPool
from gsbench.raster.staged import KernelLoss, Lifetime
from gsbench.system.jit import inlined, kernel
from gsbench.system.resources import available_cores

SHARDS = 8  # runs of rows; each shard filters ten rows of its neighbours, too
CHANNELS = 3
PAD = LANES  # zeros on both sides of a row; at least CHANNELS * WINDOW_RADIUS
TAPS = 2 * WINDOW_RADIUS + 1
WEIGHTS = window().numpy().astype(np.float32)[WINDOW_RADIUS:].copy()  # from the centre outwards
MAPS = 4  # filtered maps: image, target, sum of their squares, product
LANE = np.arange(LANES, dtype=np.float32)
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)
F_C1, F_C2 = np.float32(C1), np.float32(C2)
BYTE_MAX = np.float32(255)


@inlined
def _blur_row(source, start, target, place, numbers):
    """Filter the padded row at ``source[start:]`` horizontally; write it to ``target[place:]``."""
    for i in range(0, numbers, LANES):
        center = start + PAD + i
        total = load(source, center) * WEIGHTS[0]
        for k in range(1, WINDOW_RADIUS + 1):
            pair = load(source, center - CHANNELS * k) + load(source, center + CHANNELS * k)
            total = fma(pair, WEIGHTS[k], total)
        store(target, place + i, total)


@inlined
def _clear_slot(ring, slot, length, part, maps):
    """Set a row of a ring of ``maps`` to 0: it is outside the image."""
    for m in range(maps):
        for i in range(0, length, LANES):
            store(ring, m * part + slot + i, splat(ZERO))


@inlined
def _blur_column(ring, first, i, row, stride):
    """Filter the ring vertically around ``row``, for 16 numbers from number ``i`` of the row.

    The ring starts at ``first``; its rows are ``stride`` apart.
    """
    total = load(ring, first + row % TAPS * stride + i) * WEIGHTS[0]
    for k in range(1, WINDOW_RADIUS + 1):
        pair = load(ring, first + (row - k + TAPS) % TAPS * stride + i) + load(
            ring, first + (row + k) % TAPS * stride + i
        )
        total = fma(pair, WEIGHTS[k], total)
    return total


@inlined
def _sum(vector, scratch):
    """The sum of the 16 lanes as float64."""
    store(scratch, 0, lane_sums((vector, vector)))
    return np.float64(scratch[0])


@inlined
def _read_row(image, row, numbers, divisor, out):
    """Read a row of a float32 or uint8 image, divided by ``divisor``, into ``out[PAD:]``."""
    start = row * numbers
    if numbers < LANES:
        for i in range(numbers):
            out[PAD + i] = image[start + i] / divisor
    else:
        for i in range(0, numbers, LANES):
            # the last vector overlaps the previous one, to end with the row
            place = min(i, numbers - LANES)
            store(out, PAD + place, load(image, start + place) / divisor)


@inlined
def _write_row(line, row, numbers, image):
    """Write ``line``, which has no padding, to a row of a float32 image."""
    start = row * numbers
    if numbers < LANES:
        for i in range(numbers):
            image[start + i] = line[i]
    else:
        for i in range(0, numbers, LANES):
            place = min(i, numbers - LANES)
            store(image, start + place, load(line, place))


@kernel
def similarity_rows(
    first, past, all_memory, height, width, image, target, divisor, derivatives, sums
):
    """Write the sums of SSIM and of |image - target| of each row to ``sums`` [H, 2].

    The rows are those of the shards ``first`` to ``past``. ``derivatives`` [3, H, PAD + 3 W rounded
    up + PAD], if not empty, gets the derivatives of the sum of SSIM by the blurred image, its
    blurred square and its blurred product with the target, padded with zeros. ``all_memory`` is
    scratch for all shards.
    """
    begin, end, memory = height * first // SHARDS, height * past // SHARDS, all_memory[first]
    numbers = width * CHANNELS
    length = (numbers + LANES - 1) // LANES * LANES
    padded = length + 2 * PAD
    part = TAPS * length
    x, y, squares = memory[:padded], memory[padded:], memory[2 * padded :]
    products, ring = memory[3 * padded :], memory[4 * padded :]
    scratch = ring[MAPS * part :]
    for i in range(0, 4 * padded, LANES):
        store(memory, i, splat(ZERO))
    lane = load(LANE, 0)
    for row in range(begin - WINDOW_RADIUS, end + WINDOW_RADIUS):
        # A ring has the last eleven rows, blurred horizontally: so each is read once.
        slot = (row + TAPS) % TAPS * length
        if 0 <= row < height:
            _read_row(image, row, numbers, ONE, x)
            _read_row(target, row, numbers, divisor, y)
            l1 = splat(ZERO)
            for i in range(PAD, PAD + length, LANES):
                a, b = load(x, i), load(y, i)
                store(squares, i, fma(a, a, b * b))  # SSIM needs only the sum of both variances
                store(products, i, a * b)
                l1 += absolute(a - b)
            if begin <= row < end:
                sums[row, 1] = _sum(l1, scratch)
            for m in range(MAPS):
                _blur_row(memory, m * padded, ring, m * part + slot, numbers)
        else:
            _clear_slot(ring, slot, length, part, MAPS)
        center = row - WINDOW_RADIUS
        if center < begin:
            continue
        similarity = splat(ZERO)
        for i in range(0, numbers, LANES):
            mean_x = _blur_column(ring, 0, i, center, length)
            mean_y = _blur_column(ring, part, i, center, length)
            square = _blur_column(ring, 2 * part, i, center, length)
            product = _blur_column(ring, 3 * part, i, center, length)
            # SSIM = a1 a2 / (b1 b2) (Wang et al. 2004, eq. 13), where a1 = 2 mx my + C1, a2 = 2 cov
            # + C2, b1 = mx^2 + my^2 + C1 and b2 = vx + vy + C2. With E[.] for the blur, cov = E[xy]
            # - mx my and vx + vy = E[x^2 + y^2] - mx^2 - my^2.
            a1 = fma(mean_x * mean_y, TWO, F_C1)
            a2 = fma(product - mean_x * mean_y, TWO, F_C2)
            means = mean_x * mean_x + mean_y * mean_y
            b1 = means + F_C1
            b2 = square - means + F_C2
            inside = lane < np.float32(numbers - i)
            inverse = ONE / (b1 * b2)
            value = select(inside, a1 * a2 * inverse, ZERO)
            similarity += value
            if len(derivatives) > 0:
                # By mx: 2 (my (a2 - a1) - SSIM mx (b2 - b1)) / (b1 b2). By E[x^2]: -SSIM / b2. By
                # E[xy]: 2 a1 / (b1 b2).
                at = center * padded + PAD + i
                d_mean = (mean_y * (a2 - a1) - value * mean_x * (b2 - b1)) * inverse * TWO
                store(derivatives, at, select(inside, d_mean, ZERO))
                store(
                    derivatives, height * padded + at, select(inside, -value * b1 * inverse, ZERO)
                )
                store(
                    derivatives, 2 * height * padded + at, select(inside, TWO * a1 * inverse, ZERO)
                )
        sums[center, 0] = _sum(similarity, scratch)
        if len(derivatives) > 0:
            for m in range(3):
                start = (m * height + center) * padded
                store(derivatives, start, splat(ZERO))
                store(derivatives, start + PAD + length, splat(ZERO))


@kernel
def gradient_rows(
    first,
    past,
    all_memory,
    height,
    width,
    image,
    target,
    divisor,
    derivatives,
    l1_factor,
    ssim_factor,
    gradient,
):
    """Compute the rows of the shards ``first`` to ``past`` of ``gradient`` [H * W * 3].

    The symmetric blur is its own adjoint, so the derivatives are blurred, too.
    """
    begin, end, memory = height * first // SHARDS, height * past // SHARDS, all_memory[first]
    numbers = width * CHANNELS
    length = (numbers + LANES - 1) // LANES * LANES
    padded = length + 2 * PAD
    part = TAPS * length
    x, y, line, ring = memory[:padded], memory[padded:], memory[2 * padded :], memory[3 * padded :]
    for i in range(0, 2 * padded, LANES):
        store(memory, i, splat(ZERO))
    for row in range(begin - WINDOW_RADIUS, end + WINDOW_RADIUS):
        slot = (row + TAPS) % TAPS * length
        if 0 <= row < height:
            for m in range(3):
                _blur_row(derivatives, (m * height + row) * padded, ring, m * part + slot, numbers)
        else:
            _clear_slot(ring, slot, length, part, 3)
        center = row - WINDOW_RADIUS
        if center < begin:
            continue
        _read_row(image, center, numbers, ONE, x)
        _read_row(target, center, numbers, divisor, y)
        for i in range(0, numbers, LANES):
            a, b = load(x, PAD + i), load(y, PAD + i)
            d_mean = _blur_column(ring, 0, i, center, length)
            d_square = _blur_column(ring, part, i, center, length)
            d_product = _blur_column(ring, 2 * part, i, center, length)
            # By x: the blur of the derivative by mx, + 2 x that by E[x^2], + y that by E[xy].
            similarity = fma(d_square * TWO, a, fma(d_product, b, d_mean))
            sign = select(a > b, splat(l1_factor), select(a < b, splat(-l1_factor), ZERO))
            store(line, i, fma(similarity, -ssim_factor, sign))
        _write_row(line, center, numbers, gradient)


class CompiledLoss(KernelLoss):
    """Calls the CPU kernels with threads and pooled memory; see ``loss.PhotometricLoss``."""

    def __init__(self, ssim_weight: float, threads: int | None) -> None:
        self.ssim_weight = ssim_weight
        self._runner = ShardRunner(threads or available_cores())
        self._arenas = ArenaPool()
        self._tensors = TensorPool()

    def compute(
        self, image: Tensor, target: Tensor, differentiate: bool
    ) -> tuple[Tensor, Tensor | None]:
        """See `gsbench.raster.staged.KernelLoss`."""
        height, width, _ = image.shape
        numbers = image.numel()
        pixels, wanted = (pixels.numpy().reshape(-1) for pixels in (image, target))
        divisor = BYTE_MAX if target.dtype == torch.uint8 else ONE
        # One sum for each row, added in the order of rows: threads do not change the bits.
        sums = np.empty((height, 2))
        holder = Lifetime()
        arena = self._arenas.lease(holder)
        padded = -(-width * CHANNELS // LANES) * LANES + 2 * PAD
        derivatives = arena.take(
            "derivatives", (3 * height * padded if differentiate else 0,), np.float32
        )
        memory = arena.take("memory", (SHARDS, MAPS * (TAPS + 1) * padded + LANES), np.float32)
        common = memory, height, width, pixels, wanted, divisor, derivatives
        self._runner.run(SHARDS, similarity_rows, *common, sums)
        similarity, l1 = (float(value) / numbers for value in sums.sum(0))
        loss = (1 - self.ssim_weight) * l1 + self.ssim_weight * (1 - similarity)
        values = torch.tensor([loss, l1, similarity])
        if not differentiate:
            return values, None
        gradient = self._tensors.empty(tuple(image.shape))
        factors = (1 - self.ssim_weight) / numbers, self.ssim_weight / numbers
        outputs = *map(np.float32, factors), gradient.numpy().reshape(-1)
        self._runner.run(SHARDS, gradient_rows, *common, *outputs)
        return values, gradient
