"""The photometric loss compiled for the CPU: a fused forward pass and a hand-written gradient.

Images stay interleaved [H, W, 3]: a row is 3 W numbers, and horizontal neighbours are 3 numbers
apart. So one vector holds 16 adjacent numbers of all channels. Each row is filtered horizontally
once, into a ring buffer of 11 rows, which are then filtered vertically. Statistics of the target
are computed again in each step, so views need no further memory.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.eval.ssim import C1, C2, WINDOW_RADIUS, window
from gsbench.raster.cpu.shuffle import CHANNELS, neighbour_sums
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
PAD = LANES  # zeros on both sides of a row; at least a vector
TAPS = 2 * WINDOW_RADIUS + 1
WEIGHTS = window().numpy().astype(np.float32)[WINDOW_RADIUS:].copy()  # from the centre outwards
MAPS = 4  # filtered maps: image, target, sum of their squares, product
SLOPES = 3  # derivatives of SSIM by blurred maps
LANE = np.arange(LANES, dtype=np.float32)
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)
F_C1, F_C2 = np.float32(C1), np.float32(C2)
BYTE_MAX = np.float32(255)


@inlined
def _blur_row(source, start, target, place, numbers):
    """Filter the padded row at ``source[start:]`` horizontally; write it to ``target[place:]``."""
    before, own = load(source, start + PAD - LANES), load(source, start + PAD)
    for i in range(0, numbers, LANES):
        after = load(source, start + PAD + i + LANES)
        sums = neighbour_sums(before, own, after)
        total = fma(sums[0], WEIGHTS[1], own * WEIGHTS[0])
        total = fma(sums[1], WEIGHTS[2], total)
        total = fma(sums[2], WEIGHTS[3], total)
        total = fma(sums[3], WEIGHTS[4], total)
        store(target, place + i, fma(sums[4], WEIGHTS[5], total))
        before, own = own, after


@inlined
def _clear_slot(ring, slot, length, maps):
    """Set a row of a ring of ``maps`` to 0: it is outside the image."""
    for m in range(maps):
        for i in range(0, length, LANES):
            store(ring, m * TAPS * length + slot + i, splat(ZERO))


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
    """Write ``line[PAD:]`` to a row of a float32 image."""
    start = row * numbers
    if numbers < LANES:
        for i in range(numbers):
            image[start + i] = line[PAD + i]
    else:
        for i in range(0, numbers, LANES):
            place = min(i, numbers - LANES)
            store(image, start + place, load(line, PAD + place))


class Pictures(NamedTuple):
    """A render [H * W * 3], and the photograph that it is compared with, divided by ``divisor``."""

    image: NDArray[np.float32]
    target: NDArray[np.float32] | NDArray[np.uint8]
    divisor: np.float32
    height: int
    width: int


@inlined
def _sizes(width):
    """The numbers of a row; these rounded up to whole vectors; and these with the padding."""
    numbers = width * CHANNELS
    length = (numbers + LANES - 1) // LANES * LANES
    return numbers, length, length + 2 * PAD


@inlined
def _blur_images(row, pictures, lines, ring, slot):
    """Blur a row of the four maps horizontally, into ``ring``; return its |image - target|.

    ``lines`` [4, padded] is scratch, with zeros beside the numbers.
    """
    numbers, length, padded = _sizes(pictures.width)
    x, y, squares, products = lines, lines[padded:], lines[2 * padded :], lines[3 * padded :]
    _read_row(pictures.image, row, numbers, ONE, x)
    _read_row(pictures.target, row, numbers, pictures.divisor, y)
    l1 = splat(ZERO)
    for i in range(PAD, PAD + length, LANES):
        a, b = load(x, i), load(y, i)
        store(squares, i, fma(a, a, b * b))  # SSIM needs only the sum of both variances
        store(products, i, a * b)
        l1 += absolute(a - b)
    for m in range(MAPS):
        _blur_row(lines, m * padded, ring, m * TAPS * length + slot, numbers)
    return l1


@inlined
def _compare_row(row, width, ring, slopes):
    """The sum of SSIM of a row, by lanes; write its derivatives to ``slopes`` [3, padded].

    They are those by the blurred image, its blurred square and its blurred product with the target.
    """
    numbers, length, padded = _sizes(width)
    part = TAPS * length
    lane, similarity = load(LANE, 0), splat(ZERO)
    for i in range(0, numbers, LANES):
        mean_x = _blur_column(ring, 0, i, row, length)
        mean_y = _blur_column(ring, part, i, row, length)
        square = _blur_column(ring, 2 * part, i, row, length)
        product = _blur_column(ring, 3 * part, i, row, length)
        # SSIM = a1 a2 / (b1 b2) (Wang et al. 2004, eq. 13), where a1 = 2 mx my + C1, a2 = 2 cov +
        # C2, b1 = mx^2 + my^2 + C1 and b2 = vx + vy + C2. With E[.] for the blur, cov = E[xy] - mx
        # my and vx + vy = E[x^2 + y^2] - mx^2 - my^2.
        a1 = fma(mean_x * mean_y, TWO, F_C1)
        a2 = fma(product - mean_x * mean_y, TWO, F_C2)
        means = mean_x * mean_x + mean_y * mean_y
        b1 = means + F_C1
        b2 = square - means + F_C2
        inside = lane < np.float32(numbers - i)
        inverse = ONE / (b1 * b2)
        value = select(inside, a1 * a2 * inverse, ZERO)
        similarity += value
        # By mx: 2 (my (a2 - a1) - SSIM mx (b2 - b1)) / (b1 b2). By E[x^2]: -SSIM / b2. By E[xy]: 2
        # a1 / (b1 b2).
        d_mean = (mean_y * (a2 - a1) - value * mean_x * (b2 - b1)) * inverse * TWO
        store(slopes, PAD + i, select(inside, d_mean, ZERO))
        store(slopes, padded + PAD + i, select(inside, -value * b1 * inverse, ZERO))
        store(slopes, 2 * padded + PAD + i, select(inside, TWO * a1 * inverse, ZERO))
    return similarity


@inlined
def _differentiate_row(row, pictures, factors, ring, lines, gradient):
    """Write a row of ``gradient``; ``lines`` [3, padded] is scratch."""
    numbers, length, padded = _sizes(pictures.width)
    x, y, line = lines, lines[padded:], lines[2 * padded :]
    _read_row(pictures.image, row, numbers, ONE, x)
    _read_row(pictures.target, row, numbers, pictures.divisor, y)
    for i in range(0, numbers, LANES):
        a, b = load(x, PAD + i), load(y, PAD + i)
        d_mean = _blur_column(ring, 0, i, row, length)
        d_square = _blur_column(ring, TAPS * length, i, row, length)
        d_product = _blur_column(ring, 2 * TAPS * length, i, row, length)
        # By x: the blur of the derivative by mx, + 2 x that by E[x^2], + y that by E[xy].
        similarity = fma(d_square * TWO, a, fma(d_product, b, d_mean))
        sign = select(a > b, splat(factors[0]), select(a < b, splat(-factors[0]), ZERO))
        store(line, PAD + i, fma(similarity, -factors[1], sign))
    _write_row(line, row, numbers, gradient)


@kernel
def loss_rows(first, past, memory, pictures, factors, gradient, sums):
    """Write the sums of SSIM and of |image - target| of each row to ``sums`` [H, 2].

    The rows are those of the shards ``first`` to ``past``. ``gradient`` [H * W * 3], if not empty,
    gets that of the loss, whose ``factors`` [2] are those of |image - target| and of SSIM.
    ``memory`` [shards, …] is scratch.
    """
    height, width = pictures.height, pictures.width
    begin, end, differentiate = height * first // SHARDS, height * past // SHARDS, len(gradient) > 0
    numbers, length, padded = _sizes(width)
    lines, slopes = memory[first], memory[first][MAPS * padded :]
    # Two rings have the last eleven rows, blurred horizontally: that of the maps, and that of the
    # derivatives of SSIM by them. So the derivatives are read while they are in the cache.
    blurred = slopes[SLOPES * padded :]
    pulled = blurred[MAPS * TAPS * length :]
    scratch = pulled[SLOPES * TAPS * length :]
    for i in range(0, (MAPS + SLOPES) * padded, LANES):
        store(lines, i, splat(ZERO))
    reach = 2 * WINDOW_RADIUS if differentiate else WINDOW_RADIUS
    for row in range(begin - reach, end + reach):
        slot = (row + TAPS) % TAPS * length
        if 0 <= row < height:
            l1 = _blur_images(row, pictures, lines, blurred, slot)
            if begin <= row < end:
                sums[row, 1] = _sum(l1, scratch)
        else:
            _clear_slot(blurred, slot, length, MAPS)
        center = row - WINDOW_RADIUS  # the last row whose window is in the ring
        if center < begin - reach + WINDOW_RADIUS:
            continue
        slot = (center + TAPS) % TAPS * length
        if 0 <= center < height:
            similarity = _compare_row(center, width, blurred, slopes)
            if begin <= center < end:
                sums[center, 0] = _sum(similarity, scratch)
            # The symmetric blur is its own adjoint, so the derivatives are blurred, too.
            for m in range(SLOPES if differentiate else 0):
                _blur_row(slopes, m * padded, pulled, m * TAPS * length + slot, numbers)
        else:
            _clear_slot(pulled, slot, length, SLOPES)
        done = center - WINDOW_RADIUS
        if differentiate and done >= begin:
            _differentiate_row(done, pictures, factors, pulled, lines, gradient)


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
        size = (MAPS + SLOPES) * (TAPS + 1) * padded + LANES
        memory = arena.take("memory", (SHARDS, size), np.float32)
        gradient = self._tensors.empty((height if differentiate else 0, width, CHANNELS))
        factors = np.array([1 - self.ssim_weight, self.ssim_weight]) / numbers
        outputs = gradient.numpy().reshape(-1), sums
        pictures = Pictures(pixels, wanted, divisor, height, width)
        weights = factors.astype(np.float32)
        self._runner.run(SHARDS, loss_rows, memory, pictures, weights, *outputs)
        similarity, l1 = (float(value) / numbers for value in sums.sum(0))
        loss = (1 - self.ssim_weight) * l1 + self.ssim_weight * (1 - similarity)
        return torch.tensor([loss, l1, similarity]), gradient if differentiate else None
