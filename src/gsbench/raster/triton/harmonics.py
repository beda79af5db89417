"""Spherical harmonics for the projection kernels: colours, and their pull-back to coefficients and direction."""

from __future__ import annotations

import triton
import triton.language as tl

from gsbench.gaussians.model import NUM_SH_REST
from gsbench.gaussians.spherical_harmonics import C0, C1, C2, C3

F0, F1 = tl.constexpr(C0), tl.constexpr(C1)
D0, D1, D2, D3, D4 = (tl.constexpr(value) for value in C2)
T0, T1, T2, T3, T4, T5, T6 = (tl.constexpr(value) for value in C3)
REST = tl.constexpr(3 * NUM_SH_REST)  # numbers of a Gaussian


@triton.jit
def _add(rgb, value, place, k: tl.constexpr, mask):
    """``rgb`` plus the basis function ``value`` times the k-th coefficients of degree 1 and up."""
    return (
        rgb[0] + value * tl.load(place + 3 * k, mask=mask, other=0.0),
        rgb[1] + value * tl.load(place + 3 * k + 1, mask=mask, other=0.0),
        rgb[2] + value * tl.load(place + 3 * k + 2, mask=mask, other=0.0),
    )


@triton.jit
def colors(direction, dc, sh_rest, index, mask, DEGREE: tl.constexpr):
    """SH + 0.5 (not clamped) at the unit ``direction`` of each Gaussian ``index``, whose constant terms are ``dc``."""
    x, y, z = direction
    rgb = (dc[0] * F0 + 0.5, dc[1] * F0 + 0.5, dc[2] * F0 + 0.5)
    place = sh_rest + index * REST
    if DEGREE >= 1:
        rgb = _add(rgb, y * -F1, place, 0, mask)
        rgb = _add(rgb, z * F1, place, 1, mask)
        rgb = _add(rgb, x * -F1, place, 2, mask)
    if DEGREE >= 2:
        xx, yy, zz = x * x, y * y, z * z
        rgb = _add(rgb, x * y * D0, place, 3, mask)
        rgb = _add(rgb, y * z * D1, place, 4, mask)
        rgb = _add(rgb, (2 * zz - xx - yy) * D2, place, 5, mask)
        rgb = _add(rgb, x * z * D3, place, 6, mask)
        rgb = _add(rgb, (xx - yy) * D4, place, 7, mask)
        if DEGREE >= 3:
            rgb = _add(rgb, y * (3 * xx - yy) * T0, place, 8, mask)
            rgb = _add(rgb, x * y * z * T1, place, 9, mask)
            rgb = _add(rgb, y * (4 * zz - xx - yy) * T2, place, 10, mask)
            rgb = _add(rgb, z * (2 * zz - 3 * xx - 3 * yy) * T3, place, 11, mask)
            rgb = _add(rgb, x * (4 * zz - xx - yy) * T4, place, 12, mask)
            rgb = _add(rgb, z * (xx - yy) * T5, place, 13, mask)
            rgb = _add(rgb, x * (xx - 3 * yy) * T6, place, 14, mask)
    return rgb


@triton.jit
def _pull(g_rgb, value, place, g_place, k: tl.constexpr, mask):
    """Store the gradients of the k-th coefficients; returns the gradient at the basis function ``value``."""
    g_basis = g_rgb[0] * tl.load(place + 3 * k, mask=mask, other=0.0)
    g_basis += g_rgb[1] * tl.load(place + 3 * k + 1, mask=mask, other=0.0)
    g_basis += g_rgb[2] * tl.load(place + 3 * k + 2, mask=mask, other=0.0)
    tl.store(g_place + 3 * k, value * g_rgb[0], mask=mask)
    tl.store(g_place + 3 * k + 1, value * g_rgb[1], mask=mask)
    tl.store(g_place + 3 * k + 2, value * g_rgb[2], mask=mask)
    return g_basis


@triton.jit
def pull_back_colors(direction, g_rgb, sh_rest, g_sh_dc, g_sh_rest, index, mask, DEGREE: tl.constexpr):
    """Store the gradients of the coefficients; returns the gradient (not yet tangential) at the direction."""
    x, y, z = direction
    place, g_place = sh_rest + index * REST, g_sh_rest + index * REST
    tl.store(g_sh_dc + 3 * index, g_rgb[0] * F0, mask=mask)
    tl.store(g_sh_dc + 3 * index + 1, g_rgb[1] * F0, mask=mask)
    tl.store(g_sh_dc + 3 * index + 2, g_rgb[2] * F0, mask=mask)
    gx, gy, gz = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    if DEGREE >= 1:
        gy -= _pull(g_rgb, y * -F1, place, g_place, 0, mask) * F1
        gz += _pull(g_rgb, z * F1, place, g_place, 1, mask) * F1
        gx -= _pull(g_rgb, x * -F1, place, g_place, 2, mask) * F1
    if DEGREE >= 2:
        xx, yy, zz = x * x, y * y, z * z
        g = _pull(g_rgb, x * y * D0, place, g_place, 3, mask) * D0
        gx += g * y
        gy += g * x
        g = _pull(g_rgb, y * z * D1, place, g_place, 4, mask) * D1
        gy += g * z
        gz += g * y
        g = _pull(g_rgb, (2 * zz - xx - yy) * D2, place, g_place, 5, mask) * (2 * D2)
        gx -= g * x
        gy -= g * y
        gz += 2 * g * z
        g = _pull(g_rgb, x * z * D3, place, g_place, 6, mask) * D3
        gx += g * z
        gz += g * x
        g = _pull(g_rgb, (xx - yy) * D4, place, g_place, 7, mask) * (2 * D4)
        gx += g * x
        gy -= g * y
        if DEGREE >= 3:
            g = _pull(g_rgb, y * (3 * xx - yy) * T0, place, g_place, 8, mask) * T0
            gx += g * 6 * x * y
            gy += g * 3 * (xx - yy)
            g = _pull(g_rgb, x * y * z * T1, place, g_place, 9, mask) * T1
            gx += g * y * z
            gy += g * x * z
            gz += g * x * y
            g = _pull(g_rgb, y * (4 * zz - xx - yy) * T2, place, g_place, 10, mask) * T2
            gx -= g * 2 * x * y
            gy += g * (4 * zz - xx - 3 * yy)
            gz += g * 8 * y * z
            g = _pull(g_rgb, z * (2 * zz - 3 * xx - 3 * yy) * T3, place, g_place, 11, mask) * T3
            gx -= g * 6 * x * z
            gy -= g * 6 * y * z
            gz += g * (6 * zz - 3 * xx - 3 * yy)
            g = _pull(g_rgb, x * (4 * zz - xx - yy) * T4, place, g_place, 12, mask) * T4
            gx += g * (4 * zz - 3 * xx - yy)
            gy -= g * 2 * x * y
            gz += g * 8 * x * z
            g = _pull(g_rgb, z * (xx - yy) * T5, place, g_place, 13, mask) * T5
            gx += g * 2 * x * z
            gy -= g * 2 * y * z
            gz += g * (xx - yy)
            g = _pull(g_rgb, x * (xx - 3 * yy) * T6, place, g_place, 14, mask) * T6
            gx += g * 3 * (xx - yy)
            gy -= g * 6 * x * y
    return gx, gy, gz
