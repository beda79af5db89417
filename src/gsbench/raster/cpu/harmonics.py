"""Spherical harmonics for the projection kernels: the basis and its pull-back to the direction, in float32."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsbench.gaussians.model import NUM_SH_REST
from gsbench.gaussians.spherical_harmonics import C0, C1, C2, C3
from gsbench.raster.cpu.jit import inlined

F0, F1 = np.float32(C0), np.float32(C1)
D0, D1, D2, D3, D4 = (np.float32(value) for value in C2)
T0, T1, T2, T3, T4, T5, T6 = (np.float32(value) for value in C3)
HALF, TWO, THREE, FOUR, SIX, EIGHT = (np.float32(value) for value in (0.5, 2, 3, 4, 6, 8))
ZERO = np.float32(0)
SH_TERMS = NUM_SH_REST + 1


@inlined
def fill_basis(degree: int, x: Any, y: Any, z: Any, basis: Any) -> None:
    """Write the (degree + 1)^2 basis functions at the unit direction (x, y, z)."""
    basis[0] = F0
    if degree >= 1:
        basis[1] = -F1 * y
        basis[2] = F1 * z
        basis[3] = -F1 * x
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis[4] = D0 * x * y
        basis[5] = D1 * y * z
        basis[6] = D2 * (TWO * zz - xx - yy)
        basis[7] = D3 * x * z
        basis[8] = D4 * (xx - yy)
        if degree >= 3:
            basis[9] = T0 * y * (THREE * xx - yy)
            basis[10] = T1 * x * y * z
            basis[11] = T2 * y * (FOUR * zz - xx - yy)
            basis[12] = T3 * z * (TWO * zz - THREE * xx - THREE * yy)
            basis[13] = T4 * x * (FOUR * zz - xx - yy)
            basis[14] = T5 * z * (xx - yy)
            basis[15] = T6 * x * (xx - THREE * yy)


@inlined
def direction_gradient(degree: int, x: Any, y: Any, z: Any, g: Any) -> Any:
    """The gradient (not yet tangential) at (x, y, z) of ``sum_k g[k] basis[k]``."""
    gx, gy, gz = ZERO, ZERO, ZERO
    if degree >= 1:
        gx, gy, gz = -F1 * g[3], -F1 * g[1], F1 * g[2]
    if degree >= 2:
        gx += D0 * y * g[4] - TWO * D2 * x * g[6] + D3 * z * g[7] + TWO * D4 * x * g[8]
        gy += D0 * x * g[4] + D1 * z * g[5] - TWO * D2 * y * g[6] - TWO * D4 * y * g[8]
        gz += D1 * y * g[5] + FOUR * D2 * z * g[6] + D3 * x * g[7]
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        xy, xz, yz = x * y, x * z, y * z
        gx += (
            SIX * T0 * xy * g[9]
            + T1 * yz * g[10]
            - TWO * T2 * xy * g[11]
            - SIX * T3 * xz * g[12]
            + T4 * (FOUR * zz - THREE * xx - yy) * g[13]
            + TWO * T5 * xz * g[14]
            + THREE * T6 * (xx - yy) * g[15]
        )
        gy += (
            THREE * T0 * (xx - yy) * g[9]
            + T1 * xz * g[10]
            + T2 * (FOUR * zz - xx - THREE * yy) * g[11]
            - SIX * T3 * yz * g[12]
            - TWO * T4 * xy * g[13]
            - TWO * T5 * yz * g[14]
            - SIX * T6 * xy * g[15]
        )
        gz += (
            T1 * xy * g[10]
            + EIGHT * T2 * yz * g[11]
            + T3 * (SIX * zz - THREE * xx - THREE * yy) * g[12]
            + EIGHT * T4 * xz * g[13]
            + T5 * (xx - yy) * g[14]
        )
    return gx, gy, gz


@inlined
def add_colors(degree: int, direction: Any, sh_dc: Any, sh_rest: Any, i: int, basis: Any, rgb: Any) -> int:
    """Write the colour of Gaussian i to ``rgb`` [3]; returns a bit for each channel that was below 0 and is clamped."""
    fill_basis(degree, direction[0], direction[1], direction[2], basis)
    red, green, blue = basis[0] * sh_dc[i, 0], basis[0] * sh_dc[i, 1], basis[0] * sh_dc[i, 2]
    for k in range((degree + 1) * (degree + 1) - 1):
        red += basis[k + 1] * sh_rest[i, 3 * k]
        green += basis[k + 1] * sh_rest[i, 3 * k + 1]
        blue += basis[k + 1] * sh_rest[i, 3 * k + 2]
    red, green, blue = red + HALF, green + HALF, blue + HALF
    rgb[0] = ZERO if red < ZERO else red  # NaN stays
    rgb[1] = ZERO if green < ZERO else green
    rgb[2] = ZERO if blue < ZERO else blue
    return (1 if red < ZERO else 0) + (2 if green < ZERO else 0) + (4 if blue < ZERO else 0)


@inlined
def pull_back_colors(
    degree: int,
    direction: Any,
    g_rgb: Any,
    sh_rest: Any,
    i: int,
    basis: Any,
    g_basis: Any,
    g_sh_dc: Any,
    g_sh_rest: Any,
) -> Any:
    """Write the gradients of Gaussian i's coefficients; returns the gradient (not yet tangential) at its direction."""
    red, green, blue = g_rgb
    fill_basis(degree, direction[0], direction[1], direction[2], basis)
    g_sh_dc[i, 0], g_sh_dc[i, 1], g_sh_dc[i, 2] = basis[0] * red, basis[0] * green, basis[0] * blue
    used = (degree + 1) * (degree + 1) - 1
    for k in range(used):
        g_basis[k + 1] = red * sh_rest[i, 3 * k] + green * sh_rest[i, 3 * k + 1] + blue * sh_rest[i, 3 * k + 2]
        g_sh_rest[i, 3 * k] = basis[k + 1] * red
        g_sh_rest[i, 3 * k + 1] = basis[k + 1] * green
        g_sh_rest[i, 3 * k + 2] = basis[k + 1] * blue
    for k in range(3 * used, g_sh_rest.shape[1]):
        g_sh_rest[i, k] = ZERO
    return direction_gradient(degree, direction[0], direction[1], direction[2], g_basis)
