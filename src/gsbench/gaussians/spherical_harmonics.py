"""View-dependent colour: real spherical harmonics up to degree 3, in the order and signs of the 3DGS PLY layout."""

from __future__ import annotations

import math

import torch
from torch import Tensor

C0 = math.sqrt(1 / (4 * math.pi))  # 0.28209479177387814
C1 = math.sqrt(3 / (4 * math.pi))
C2 = (  # xy, yz, 3z^2 - 1, xz, x^2 - y^2
    math.sqrt(15 / (4 * math.pi)),
    -math.sqrt(15 / (4 * math.pi)),
    math.sqrt(5 / (16 * math.pi)),
    -math.sqrt(15 / (4 * math.pi)),
    math.sqrt(15 / (16 * math.pi)),
)
C3 = (
    -math.sqrt(35 / (32 * math.pi)),
    math.sqrt(105 / (4 * math.pi)),
    -math.sqrt(21 / (32 * math.pi)),
    math.sqrt(7 / (16 * math.pi)),
    -math.sqrt(21 / (32 * math.pi)),
    math.sqrt(105 / (16 * math.pi)),
    -math.sqrt(35 / (32 * math.pi)),
)


def basis(directions: Tensor, degree: int) -> Tensor:
    """The (degree + 1)^2 basis functions at unit ``directions`` [N, 3], as [N, (degree + 1)^2]."""
    x, y, z = directions.unbind(-1)  # each [N]
    terms = [torch.full_like(x, C0)]
    if degree >= 1:
        terms += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        terms += [
            C2[0] * x * y,
            C2[1] * y * z,
            C2[2] * (2 * z * z - x * x - y * y),
            C2[3] * x * z,
            C2[4] * (x * x - y * y),
        ]
    if degree >= 3:
        terms += [
            C3[0] * y * (3 * x * x - y * y),
            C3[1] * x * y * z,
            C3[2] * y * (4 * z * z - x * x - y * y),
            C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
            C3[4] * x * (4 * z * z - x * x - y * y),
            C3[5] * z * (x * x - y * y),
            C3[6] * x * (x * x - 3 * y * y),
        ]
    return torch.stack(terms, -1)


def colors(sh_dc: Tensor, sh_rest: Tensor, directions: Tensor, degree: int) -> Tensor:
    """RGB [N, 3], at least 0, of coefficients [N, 3] and [N, 15, 3] seen along unit ``directions`` [N, 3]."""
    values = basis(directions, degree)  # [N, K]
    rgb = values[:, :1] * sh_dc
    if degree > 0:
        rest = values[:, 1:]  # [N, K - 1]
        rgb = rgb + torch.einsum("nk,nkc->nc", rest, sh_rest[:, : rest.shape[1]])
    return torch.clamp_min(rgb + 0.5, 0.0)


def rgb_to_dc(rgb: Tensor) -> Tensor:
    """The constant coefficient that shows colour ``rgb`` (0 to 1) from every side."""
    return (rgb - 0.5) / C0


def dc_to_rgb(sh_dc: Tensor) -> Tensor:
    """The inverse of ``rgb_to_dc``, not clamped."""
    return sh_dc * C0 + 0.5
