"""A set of 3D Gaussians: raw parameters, activations, and colours by spherical harmonics."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.words import NamesAttributes

MAX_SH_DEGREE = 3
NUM_SH_REST = (MAX_SH_DEGREE + 1) ** 2 - 1  # 15 coefficients per channel besides the constant one


@dataclass
class Gaussians(NamesAttributes):
    """N Gaussians as raw parameters (before activation), of one dtype and on one device.

    | field          | shape      | activation                                   |
    |----------------|------------|----------------------------------------------|
    | means          | [N, 3]     | none, world units                            |
    | log_scales     | [N, 3]     | exp: standard deviations, world units        |
    | quaternions    | [N, 4]     | normalise: w, x, y, z                        |
    | opacity_logits | [N]        | sigmoid                                      |
    | sh_dc          | [N, 3]     | colour = max(0, SH + 0.5); channels r, g, b  |
    | sh_rest        | [N, 15, 3] | degrees 1 to 3                               |
    """

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    opacity_logits: Tensor
    sh_dc: Tensor
    sh_rest: Tensor

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        expected = {
            "means": (n, 3),
            "log_scales": (n, 3),
            "quaternions": (n, 4),
            "opacity_logits": (n,),
            "sh_dc": (n, 3),
            "sh_rest": (n, NUM_SH_REST, 3),
        }
        for name, shape in expected.items():
            given = tuple(getattr(self, name).shape)
            if given != shape:
                raise ValueError(f"gaussians: {name} has shape {given}, expected {shape}")

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def scales(self) -> Tensor:
        return self.log_scales.exp()  # [N, 3]

    @property
    def opacities(self) -> Tensor:
        return self.opacity_logits.sigmoid()  # [N]

    @property
    def rotations(self) -> Tensor:
        """Rotation matrices, [N, 3, 3]; the columns are the axes of the ellipsoids."""
        return quaternion_to_matrix(self.quaternions)

    def tensors(self) -> dict[str, Tensor]:
        """The six tensors by name, in the order of the table above."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """Apply ``function`` to every tensor."""
        return Gaussians(**{name: function(tensor) for name, tensor in self.tensors().items()})

    def select(self, index: Tensor) -> Gaussians:
        """Copy the Gaussians at a boolean mask [N] or integer index [M]."""
        return self.map(lambda tensor: tensor[index])

    def detach(self) -> Gaussians:
        return self.map(Tensor.detach)

    @staticmethod
    def concatenate(parts: list[Gaussians]) -> Gaussians:
        columns = zip(*(part.tensors().values() for part in parts), strict=True)
        return Gaussians(*map(torch.cat, columns))


def quaternion_to_matrix(quaternions: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] (w, x, y, z) of any length."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=-1).unbind(-1)  # each [N]
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def _factor(numerator: int, denominator: int) -> float:
    """A factor of the real spherical harmonics: the root of a fraction over pi."""
    return math.sqrt(numerator / (denominator * math.pi))


C0 = _factor(1, 4)  # 0.28209479177387814
C1 = _factor(3, 4)
# of xy, yz, 3z^2 - 1, xz, x^2 - y^2
C2 = (_factor(15, 4), -_factor(15, 4), _factor(5, 16), -_factor(15, 4), _factor(15, 16))
C3 = (
    -_factor(35, 32),
    _factor(105, 4),
    -_factor(21, 32),
    _factor(7, 16),
    -_factor(21, 32),
    _factor(105, 16),
    -_factor(35, 32),
)


def basis(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics to ``degree`` at unit ``directions`` [N, 3]: [N, (degree + 1)^2]."""
    # Sloan 2008, "Stupid Spherical Harmonics Tricks", appendix A2, with the signs of 3DGS's code.
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
    """RGB [N, 3] >= 0 of coefficients [N, 3] and [N, 15, 3] in unit ``directions`` [N, 3]."""
    values = basis(directions, degree)  # [N, K]
    rgb = values[:, :1] * sh_dc
    if degree > 0:
        rest = values[:, 1:]  # [N, K - 1]
        rgb = rgb + torch.einsum("nk,nkc->nc", rest, sh_rest[:, : rest.shape[1]])
    return torch.clamp_min(rgb + 0.5, 0.0)


def rgb_to_dc(rgb: Tensor) -> Tensor:
    """The coefficients of degree 0 that give colour ``rgb`` (0 to 1) in every direction."""
    return (rgb - 0.5) / C0


def dc_to_bytes(sh_dc: Tensor) -> NDArray[np.uint8]:
    """The colours [N, 3] from 0 to 255 that harmonics [N, 3] stand for: ``rgb_to_dc`` inverted."""
    return ((sh_dc * C0 + 0.5).clamp(0, 1) * 255).round().byte().cpu().numpy()
