"""Access to Gaussians, their spherical harmonics, and the formulas, one lane per Gaussian."""

from __future__ import annotations

from typing import Any

import triton
import triton.language as tl

from gsbench.gaussians.model import C0, C1, C2, C3, NUM_SH_REST
from gsbench.raster import formulas
from gsbench.raster.base import CameraNumbers

F0, F1 = tl.constexpr(C0), tl.constexpr(C1)
D0, D1, D2, D3, D4 = (tl.constexpr(value) for value in C2)
T0, T1, T2, T3, T4, T5, T6 = (tl.constexpr(value) for value in C3)
NUM_CAMERA = tl.constexpr(len(CameraNumbers._fields))
NUM_SH = tl.constexpr(NUM_SH_REST)  # vectors of one Gaussian in ``sh_rest``


@triton.jit
def load_camera(numbers):
    """The camera whose ``numbers`` [NUM_CAMERA] are in memory, in the order of `CameraNumbers`.

    They are in memory, not among the arguments, so that a recorded launch serves every view.
    """
    loaded = ()
    for k in tl.static_range(NUM_CAMERA):
        loaded = loaded + (tl.load(numbers + k),)  # type: ignore[assignment]  # noqa: RUF005
    return CameraNumbers(*loaded)  # type: ignore[call-arg]


@triton.jit
def load_vector(array, index, mask):
    """Load the rows ``index`` of an array [N, 3]; 0 outside ``mask``."""
    place = array + 3 * index
    return (
        tl.load(place, mask=mask, other=0.0),
        tl.load(place + 1, mask=mask, other=0.0),
        tl.load(place + 2, mask=mask, other=0.0),
    )


@triton.jit
def store_vector(array, index, values, mask):
    place = array + 3 * index
    tl.store(place, values[0], mask=mask)
    tl.store(place + 1, values[1], mask=mask)
    tl.store(place + 2, values[2], mask=mask)


@triton.jit
def store_or_zero(place, value, seen, inside):
    """Store ``value`` where a Gaussian is ``seen``, 0 for the others ``inside`` the arrays."""
    tl.store(place, tl.where(seen, value, 0.0), mask=inside)


@triton.jit
def load_quaternion(quaternions, index, mask):
    """The unit quaternions (w, x, y, z); the inverse and the squared norm of the stored ones."""
    place = quaternions + 4 * index
    w = tl.load(place, mask=mask, other=1.0)
    x = tl.load(place + 1, mask=mask, other=0.0)
    y = tl.load(place + 2, mask=mask, other=0.0)
    z = tl.load(place + 3, mask=mask, other=0.0)
    squared = w * w + x * x + y * y + z * z
    inverse = 1.0 / tl.sqrt(squared)
    return (w * inverse, x * inverse, y * inverse, z * inverse), inverse, squared


@triton.jit
def select(condition, a, b):
    return tl.where(condition, a, b)


@triton.jit
def minimum(a, b):
    return tl.minimum(a, b)


@triton.jit
def maximum(a, b):
    return tl.maximum(a, b)


@triton.jit
def square_root(a):
    return tl.sqrt(a)


@triton.jit
def floor(a):
    return tl.floor(a)


@triton.jit
def ceil(a):
    return tl.ceil(a)


@triton.jit
def exponentials(row):
    return tl.exp(row[0]), tl.exp(row[1]), tl.exp(row[2])


# ``tl`` is among the names because Triton's interpreter takes only functions that can see it.
OF_LANES = formulas.compiled(
    triton.jit,
    tl.constexpr,
    tl=tl,
    select=select,
    minimum=minimum,
    maximum=maximum,
    square_root=square_root,
    floor=floor,
    ceil=ceil,
)
dot, plus, stretched = OF_LANES.dot, OF_LANES.plus, OF_LANES.stretched


def __getattr__(name: str) -> Any:
    """The other formulas, so that kernels import them from here."""
    return getattr(OF_LANES, name)


@triton.jit
def normalized(offset):
    """``offset`` scaled to length 1, and the inverse of its length. Length 0 gives 0 and 1."""
    distance = tl.sqrt(dot(offset, offset))
    inverse = 1.0 / tl.where(distance > 0, distance, 1.0)
    return stretched(offset, inverse), inverse


@triton.jit
def basis(direction, DEGREE: tl.constexpr):
    """The basis functions of degrees 1 to ``DEGREE``, at least 1, at unit directions."""
    x, y, z = direction
    values = (y * -F1, z * F1, x * -F1)
    if DEGREE >= 2:
        xx, yy, zz = x * x, y * y, z * z
        quadratic = (x * y * D0, y * z * D1, (2 * zz - xx - yy) * D2, x * z * D3, (xx - yy) * D4)
        values = values + quadratic  # type: ignore[assignment]
        if DEGREE >= 3:
            cubic = (
                y * (3 * xx - yy) * T0,
                x * y * z * T1,
                y * (4 * zz - xx - yy) * T2,
                z * (2 * zz - 3 * xx - 3 * yy) * T3,
                x * (4 * zz - xx - yy) * T4,
                z * (xx - yy) * T5,
                x * (xx - 3 * yy) * T6,
            )
            values = values + cubic  # type: ignore[assignment]
    return values


@triton.jit
def _slopes(direction, DEGREE: tl.constexpr):
    """The derivatives of `basis` by x, y and z of the direction; None is 0.

    They are not projected to the tangent plane of the unit sphere.
    """
    x, y, z = direction
    found = ((None, -F1, None), (None, None, F1), (-F1, None, None))
    if DEGREE >= 2:
        quadratic = (
            (D0 * y, D0 * x, None),
            (None, D1 * z, D1 * y),
            (-2 * D2 * x, -2 * D2 * y, 4 * D2 * z),
            (D3 * z, None, D3 * x),
            (2 * D4 * x, -2 * D4 * y, None),
        )
        found = found + quadratic  # type: ignore[assignment]
        if DEGREE >= 3:
            xx, yy, zz = x * x, y * y, z * z
            xy, yz, xz = x * y, y * z, x * z
            cubic = (
                (6 * T0 * xy, 3 * T0 * (xx - yy), None),
                (T1 * yz, T1 * xz, T1 * xy),
                (-2 * T2 * xy, T2 * (4 * zz - xx - 3 * yy), 8 * T2 * yz),
                (-6 * T3 * xz, -6 * T3 * yz, T3 * (6 * zz - 3 * xx - 3 * yy)),
                (T4 * (4 * zz - 3 * xx - yy), -2 * T4 * xy, 8 * T4 * xz),
                (2 * T5 * xz, -2 * T5 * yz, T5 * (xx - yy)),
                (3 * T6 * (xx - yy), -6 * T6 * xy, None),
            )
            found = found + cubic  # type: ignore[assignment]
    return found


@triton.jit
def colors(direction, dc, sh_rest, index, mask, DEGREE: tl.constexpr):
    """The colours SH + 0.5, not clamped, of the Gaussians ``index`` at unit directions.

    Also returns their derivatives by x, y and z of the direction, each for red, green and blue; see
    `_slopes`. ``dc`` are the coefficients of degree 0. The formulas are those of
    computeColorFromSH of 3DGS, with the constants of `gaussians.model`.
    """
    rgb = (dc[0] * F0 + 0.5, dc[1] * F0 + 0.5, dc[2] * F0 + 0.5)
    zero = tl.zeros_like(direction[0])
    by_x, by_y, by_z = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
    if DEGREE >= 1:
        values, slopes = basis(direction, DEGREE), _slopes(direction, DEGREE)
        for k in tl.static_range((DEGREE + 1) * (DEGREE + 1) - 1):
            c = load_vector(sh_rest + 3 * k, index * NUM_SH, mask)  # of red, green and blue
            rgb = plus(rgb, values[k], c)
            if slopes[k][0] is not None:
                by_x = plus(by_x, slopes[k][0], c)
            if slopes[k][1] is not None:
                by_y = plus(by_y, slopes[k][1], c)
            if slopes[k][2] is not None:
                by_z = plus(by_z, slopes[k][2], c)
    return rgb, by_x, by_y, by_z


@triton.jit
def _four_columns(a, b, c, d):
    """Four arrays [N] as the columns of one [N, 4]."""
    return tl.reshape(tl.join(tl.join(a, c), tl.join(b, d)), [a.shape[0], 4])


@triton.jit
def store_gradients(direction, g_rgb, g_sh_rest, index, mask, DEGREE: tl.constexpr):
    """Store the gradients by the coefficients of degrees 1 to ``DEGREE``.

    They are products of a basis function and a colour. Four functions at a time, as an array
    [N, basis, colour], are stored by lanes in the order of memory. With one lane per Gaussian, each
    instruction would write to 32 places far apart.
    """
    if DEGREE >= 1:
        zero = tl.zeros_like(g_rgb[0])
        count: tl.constexpr = (DEGREE + 1) * (DEGREE + 1) - 1
        values = basis(direction, DEGREE) + (zero,)  # noqa: RUF005
        rgb = _four_columns(g_rgb[0], g_rgb[1], g_rgb[2], zero)
        k, c = tl.arange(0, 4)[None, :, None], tl.arange(0, 4)[None, None, :]
        place = g_sh_rest + (index * (3 * NUM_SH))[:, None, None] + (3 * k + c)
        seen = mask[:, None, None] & (c < 3)
        for first in tl.static_range(0, count, 4):
            four = _four_columns(*values[first : first + 4])
            own = four[:, :, None] * rgb[:, None, :]
            tl.store(place + 3 * first, own, mask=seen & (k + first < count))
