"""The photometric loss in Triton kernels. The host never waits for values from the device.

Images stay interleaved [H, W, 3]: a row is 3 W numbers, and horizontal neighbours are 3 numbers
apart. A program processes a strip of numbers from top to bottom, one lane per number of a row. It
filters each row horizontally and adds it to eleven running vertical sums, of which one is complete
after each row.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from gsbench.eval.ssim import C1, C2, WINDOW_RADIUS, window
from gsbench.raster.executors import load_driver
from gsbench.raster.staged import KernelLoss, Lifetime
from gsbench.raster.triton.launch import Workspace, WorkspacePool, launch_grid

STRIP = 128  # numbers of a row per program
MIN_ROWS = 8  # rows per program
# The numbers of programs are chosen for an H100 or H200. A multiprocessor holds six programs at
# once: it has 65,536 registers, and each of the 128 lanes of a program uses at most 80.
MULTIPROCESSORS, PROGRAMS_HELD = 132, 6
# Without this limit, the kernels take up to 91 registers for the same loads. ROCm has none.
REGISTERS = {} if torch.version.hip else {"maxnreg": 80}
RADIUS = tl.constexpr(WINDOW_RADIUS)
CHANNELS = tl.constexpr(3)
# from the centre outwards
W0, W1, W2, W3, W4, W5 = (tl.constexpr(weight) for weight in window()[WINDOW_RADIUS:].tolist())
F_C1, F_C2 = tl.constexpr(C1), tl.constexpr(C2)


@cache
def rows_of_program(height: int, numbers: int) -> int:
    """The number of rows per program, for an image of ``height`` rows of ``numbers`` each.

    A program filters ``2 * RADIUS`` rows besides its own, so few programs do less work in all. But
    each one waits for memory most of the time: a multiprocessor is busiest with as many as it
    holds. The result depends only on the size of the image, so every GPU adds up in the same order.
    """
    lines = max(1, PROGRAMS_HELD * MULTIPROCESSORS // triton.cdiv(numbers, STRIP))
    return max(MIN_ROWS, triton.cdiv(height, lines))


@triton.jit
def _weight(k: tl.constexpr):
    """The weight of the window at ``k`` px from its centre."""
    return (W0, W1, W2, W3, W4, W5)[k]


@triton.jit
def _zeros(like):
    """A running sum for each row of the window, all zero."""
    # Triton's tuples grow by ``+``; it knows neither ``*`` nor comprehensions.
    sums = ()
    for _ in tl.static_range(2 * RADIUS + 1):
        sums = sums + (tl.zeros_like(like),)  # type: ignore[assignment]  # noqa: RUF005
    return sums


@triton.jit
def _push(sums, value):
    """Add the horizontally blurred ``value`` of the next row to the running sums.

    The first of the returned sums is complete.
    """
    pushed = ()
    for k in tl.static_range(2 * RADIUS):
        weight = _weight(RADIUS - k if k < RADIUS else k - RADIUS)
        pushed = pushed + (tl.fma(value, weight, sums[k + 1]),)  # type: ignore[assignment]  # noqa: RUF005
    return pushed + (value * _weight(RADIUS),)  # noqa: RUF005


@triton.jit
def _load(row, number, limit, offset: tl.constexpr, scale):
    """Load numbers of a row, ``offset`` from the lanes' own, as float32, times ``scale``.

    ``row`` are the lanes' pointers. The result is 0 where the number is not in [0, ``limit``).
    """
    # Constants are added to the pointers last: they cost neither registers nor instructions there.
    # As unsigned, negative numbers are above every limit.
    inside = (number + offset).to(tl.uint32) < limit.to(tl.uint32)
    return tl.load(row + offset, mask=inside, other=0).to(tl.float32) * scale


@triton.jit
def _add(sums, x, y, weight):
    """Add x, y, x^2 + y^2 and x y, times ``weight``, to four sums."""
    wx, wy = x * weight, y * weight
    return (
        sums[0] + wx,
        sums[1] + wy,
        tl.fma(wx, x, tl.fma(wy, y, sums[2])),
        tl.fma(wx, y, sums[3]),
    )


@triton.jit
def _similarity(mx, my, squares, product):
    """SSIM, and its derivatives by the blurred image, its blurred square and the blurred product.

    SSIM = a1 a2 / (b1 b2) (Wang et al. 2004, eq. 13); `loss_cpu` has it in full.
    """
    means = mx * mx + my * my
    a1, a2 = 2 * mx * my + F_C1, 2 * (product - mx * my) + F_C2
    b1, b2 = means + F_C1, squares - means + F_C2
    inverse = 1.0 / (b1 * b2)
    similarity = a1 * a2 * inverse
    by_mean = 2 * (my * (a2 - a1) - similarity * mx * (b2 - b1)) * inverse
    return similarity, by_mean, -similarity * b1 * inverse, 2 * a1 * inverse


@triton.jit(do_not_specialize=["height", "numbers", "rows"])
def measure_similarity(
    image,
    target,
    scale,
    height,
    numbers,
    derivatives,
    sums,
    rows,
    DIFFERENTIATE: tl.constexpr,
    STRIP: tl.constexpr,
):
    """Write the sums of SSIM and of |image - scale * target| to ``sums`` [programs, 2].

    Each program has ``rows`` rows. If ``DIFFERENTIATE``, ``derivatives`` [3, H, 3 W] gets the
    derivatives of the sum of SSIM by the blurred image, its blurred square and its blurred product
    with the target.
    """
    number = tl.program_id(0) * STRIP + tl.arange(0, STRIP)  # [STRIP] of a row
    first = tl.program_id(1) * rows
    zero = tl.zeros([STRIP], tl.float32)
    # SSIM needs the squares of both images only as a sum, which saves eleven registers.
    mean_x, mean_y, squares, product = _zeros(zero), _zeros(zero), _zeros(zero), _zeros(zero)
    total_similarity, total_l1 = zero, zero
    plane = height.to(tl.int64) * numbers
    for row in range(first - RADIUS, tl.minimum(first + rows, height) + RADIUS):
        # Windows of the first and the last row reach RADIUS rows beyond; L1 does not count these.
        limit = tl.where((row >= 0) & (row < height), numbers, 0)
        xs, ys = image + (row * numbers + number), target + (row * numbers + number)
        x = _load(xs, number, limit, 0, 1.0)
        y = _load(ys, number, limit, 0, scale)
        total_l1 += tl.where((row >= first) & (row < first + rows), tl.abs(x - y), 0.0)
        blurred = _add((zero, zero, zero, zero), x, y, W0)
        for k in tl.static_range(1, RADIUS + 1):
            for side in tl.static_range(-1, 2, 2):
                x = _load(xs, number, limit, side * k * CHANNELS, 1.0)
                y = _load(ys, number, limit, side * k * CHANNELS, scale)
                blurred = _add(blurred, x, y, _weight(k))
        # A row is blurred horizontally once, and added to the eleven rows whose windows it is in.
        # The sums of the row RADIUS above are now complete.
        mean_x, mean_y = _push(mean_x, blurred[0]), _push(mean_y, blurred[1])
        squares, product = _push(squares, blurred[2]), _push(product, blurred[3])

        center = row - RADIUS
        inside = (center >= first) & (number < numbers)
        similarity, by_mean, by_square, by_product = _similarity(
            mean_x[0], mean_y[0], squares[0], product[0]
        )
        total_similarity += tl.where(inside, similarity, 0.0)
        if DIFFERENTIATE:
            place = derivatives + center * numbers + number
            tl.store(place, by_mean, mask=inside)
            tl.store(place + plane, by_square, mask=inside)
            tl.store(place + 2 * plane, by_product, mask=inside)
    program = tl.program_id(1) * tl.num_programs(0) + tl.program_id(0)
    # Atomics would add in any order; `add_up` adds these in one order, for the same bits.
    tl.store(sums + 2 * program, tl.sum(total_similarity, 0))
    tl.store(sums + 2 * program + 1, tl.sum(total_l1, 0))


@triton.jit(do_not_specialize=["programs"])
def add_up(sums, programs, size, ssim_weight, values, GROUP: tl.constexpr):
    """Write loss, mean L1 and mean SSIM to ``values`` [3].

    ``sums`` [programs, 2] are those of `measure_similarity`, over ``size`` numbers in all.
    """
    similarity, l1 = tl.zeros([GROUP], tl.float32), tl.zeros([GROUP], tl.float32)
    for start in range(0, programs, GROUP):
        program = start + tl.arange(0, GROUP)
        similarity += tl.load(sums + 2 * program, mask=program < programs, other=0.0)
        l1 += tl.load(sums + 2 * program + 1, mask=program < programs, other=0.0)
    mean_similarity, mean_l1 = tl.sum(similarity, 0) / size, tl.sum(l1, 0) / size
    tl.store(values, (1.0 - ssim_weight) * mean_l1 + ssim_weight * (1.0 - mean_similarity))
    tl.store(values + 1, mean_l1)
    tl.store(values + 2, mean_similarity)


@triton.jit(do_not_specialize=["height", "numbers", "rows"])
def differentiate(
    image,
    target,
    scale,
    height,
    numbers,
    derivatives,
    ssim_weight,
    gradient,
    rows,
    STRIP: tl.constexpr,
):
    """Compute the ``gradient`` [H, 3 W] by the image.

    The symmetric blur is its own adjoint, so the derivatives are blurred, too.
    """
    number = tl.program_id(0) * STRIP + tl.arange(0, STRIP)  # [STRIP] of a row
    first = tl.program_id(1) * rows
    zero = tl.zeros([STRIP], tl.float32)
    d_mean, d_square, d_product = _zeros(zero), _zeros(zero), _zeros(zero)
    plane = height.to(tl.int64) * numbers
    factor = 1.0 / (height * numbers).to(tl.float32)
    l1_factor, ssim_factor = factor * (1.0 - ssim_weight), factor * ssim_weight
    for row in range(first - RADIUS, tl.minimum(first + rows, height) + RADIUS):
        limit = tl.where((row >= 0) & (row < height), numbers, 0)
        means = derivatives + (row * numbers + number)
        squares, products = means + plane, means + 2 * plane
        mean = W0 * _load(means, number, limit, 0, 1.0)
        square = W0 * _load(squares, number, limit, 0, 1.0)
        product = W0 * _load(products, number, limit, 0, 1.0)
        for k in tl.static_range(1, RADIUS + 1):
            for side in tl.static_range(-1, 2, 2):
                mean += _load(means, number, limit, side * k * CHANNELS, _weight(k))
                square += _load(squares, number, limit, side * k * CHANNELS, _weight(k))
                product += _load(products, number, limit, side * k * CHANNELS, _weight(k))
        d_mean = _push(d_mean, mean)
        d_square = _push(d_square, square)
        d_product = _push(d_product, product)

        center = row - RADIUS
        inside = (center >= first) & (number < numbers)
        x = tl.load(image + center * numbers + number, mask=inside, other=0.0)
        y = tl.load(target + center * numbers + number, mask=inside, other=0).to(tl.float32) * scale
        # By x: the blur of the derivative by mx, + 2 x that by E[x^2], + y that by E[xy].
        similarity = d_mean[0] + 2 * d_square[0] * x + d_product[0] * y
        sign = tl.where(x > y, l1_factor, tl.where(x < y, -l1_factor, 0.0))
        tl.store(gradient + center * numbers + number, sign - ssim_factor * similarity, mask=inside)


class TritonLoss(KernelLoss):
    """Calls the kernels with pooled memory; see ``loss.PhotometricLoss``.

    Results have the same bits on every run on one GPU.
    """

    def __init__(self, ssim_weight: float) -> None:
        self.ssim_weight = ssim_weight
        self.pool = WorkspacePool()

    def compute(
        self, image: Tensor, target: Tensor, differentiate: bool
    ) -> tuple[Tensor, Tensor | None]:
        """See `gsbench.raster.staged.KernelLoss`."""
        if image.device.type == "cuda":
            load_driver()
        holder = Lifetime()
        values, gradient = image.new_empty(3), torch.empty_like(image) if differentiate else None
        with torch.cuda.device_of(image):
            self.launch(image, target, values, gradient, self.pool.lease(holder, image.device))
        return values, gradient

    def launch(
        self,
        image: Tensor,
        target: Tensor,
        values: Tensor,
        gradient: Tensor | None,
        memory: Workspace,
    ) -> None:
        """Write loss, L1 and SSIM to ``values`` [3], and the ``gradient`` by the image, if wanted.

        All are contiguous.
        """
        (height, width, _), wanted = image.shape, gradient is not None
        numbers, size = 3 * width, image.numel()
        rows = rows_of_program(height, numbers)
        grid = columns, lines = triton.cdiv(numbers, STRIP), triton.cdiv(height, rows)
        sums = memory.take("sums", 2 * columns * lines, torch.float32)
        common: dict[str, Any] = {
            "image": image,
            "target": target,
            "scale": 1 / 255 if target.dtype == torch.uint8 else 1.0,
            "height": height,
            "numbers": numbers,
            "derivatives": memory.take("derivatives", 3 * size * wanted, torch.float32),
            "rows": rows,
            "STRIP": STRIP,
            **REGISTERS,
        }
        launch_grid(measure_similarity, *grid)(**common, sums=sums, DIFFERENTIATE=wanted)
        launch_grid(add_up, 1)(
            sums=sums,
            programs=columns * lines,
            size=float(size),
            ssim_weight=self.ssim_weight,
            values=values,
            GROUP=1024,
        )
        if wanted:
            launch_grid(differentiate, *grid)(
                **common, ssim_weight=self.ssim_weight, gradient=gradient
            )
