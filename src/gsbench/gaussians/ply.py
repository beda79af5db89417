"""The standard 3DGS point-cloud file, which viewers and other trainers read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement, PlyParseError

from gsbench.errors import InputError
from gsbench.files import atomic
from gsbench.gaussians.model import NUM_SH_REST, Gaussians

NUM_REST = 3 * NUM_SH_REST  # f_rest is stored channel by channel: 15 of red, 15 of green, 15 of blue
COLUMNS = (
    ["x", "y", "z", "nx", "ny", "nz"]
    + [f"f_dc_{i}" for i in range(3)]
    + [f"f_rest_{i}" for i in range(NUM_REST)]
    + ["opacity"]
    + [f"scale_{i}" for i in range(3)]
    + [f"rot_{i}" for i in range(4)]
)


def write_ply(gaussians: Gaussians, path: Path) -> None:
    """Write raw parameters as float32, binary little-endian, in INRIA's column order (normals are zero); atomic."""
    raw = gaussians.detach().map(lambda tensor: tensor.float().cpu())
    table = torch.cat(
        [
            raw.means,
            torch.zeros_like(raw.means),
            raw.sh_dc,
            raw.sh_rest.transpose(1, 2).reshape(len(raw), NUM_REST),
            raw.opacity_logits.unsqueeze(-1),
            raw.log_scales,
            raw.quaternions,
        ],
        dim=1,
    ).numpy()  # [N, 62]
    vertices = np.ascontiguousarray(table, dtype="<f4").view([(name, "<f4") for name in COLUMNS]).reshape(len(raw))
    with atomic(path, sync=False) as temporary:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(temporary))


def read_ply(path: Path, device: torch.device | str = "cpu") -> Gaussians:
    """Read a 3DGS PLY of SH degree 0 to 3 (missing higher coefficients become zero), float32.

    Raises InputError where the file is not a PLY or lacks a property.
    """
    try:
        vertices = PlyData.read(str(path))["vertex"].data
    except (OSError, KeyError, PlyParseError, ValueError) as error:
        raise InputError(f"{path}: not a readable PLY of Gaussians ({error})") from error
    present = set(vertices.dtype.names)
    rest = sorted((name for name in present if name.startswith("f_rest_")), key=lambda name: int(name.split("_")[2]))
    required = [name for name in COLUMNS if not name.startswith(("f_rest_", "n"))]
    missing = [name for name in required if name not in present]
    if missing or len(rest) % 3 or len(rest) > NUM_REST:
        raise InputError(f"{path}: not a 3DGS PLY; missing or odd properties: {', '.join(missing) or 'f_rest_*'}")

    def columns(names: list[str]) -> torch.Tensor:
        return torch.from_numpy(np.stack([vertices[name].astype(np.float32) for name in names], axis=1)).to(device)

    n, stored = len(vertices), len(rest) // 3
    sh_rest = torch.zeros(n, NUM_SH_REST, 3, device=device)
    if stored:
        sh_rest[:, :stored] = columns(rest).reshape(n, 3, stored).transpose(1, 2)
    return Gaussians(
        means=columns(["x", "y", "z"]),
        log_scales=columns([f"scale_{i}" for i in range(3)]),
        quaternions=columns([f"rot_{i}" for i in range(4)]),
        opacity_logits=columns(["opacity"]).squeeze(-1),
        sh_dc=columns([f"f_dc_{i}" for i in range(3)]),
        sh_rest=sh_rest,
    )
