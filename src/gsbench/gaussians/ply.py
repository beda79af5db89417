"""The PLY file of 3DGS, which viewers and other trainers read."""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from gsbench.errors import InputError
from gsbench.files import DAMAGE, atomic
from gsbench.gaussians.model import NUM_SH_REST, Gaussians
from gsbench.gaussians.ply_files import (
    check_columns,
    filtered,
    is_filter,
    read_header,
    read_ply_data,
    report_header,
)
from gsbench.normalization import IDENTITY, Normalization
from gsbench.words import counted

log = logging.getLogger(__name__)

# f_rest is stored channel by channel: 15 of red, 15 of green, 15 of blue
NUM_REST = 3 * NUM_SH_REST
REST = "f_rest_"
POSITION = ["x", "y", "z"]
DC, SCALES = ([f"{kind}_{i}" for i in range(3)] for kind in ("f_dc", "scale"))
ROTATIONS = [f"rot_{i}" for i in range(4)]
REQUIRED = [*POSITION, *DC, "opacity", *SCALES, *ROTATIONS]
ALL_REST = [f"{REST}{i}" for i in range(NUM_REST)]
COLUMNS = [*POSITION, "nx", "ny", "nz", *DC, *ALL_REST, "opacity", *SCALES, *ROTATIONS]
Column = NDArray[Any]  # [N]
T = TypeVar("T")

# Marks files of gsbench, whose values need no doubt.
OWN_COMMENT = "written by gsbench"

REST_COUNTS = (0, 9, 24, 45)  # of SH degree 0 to 3
# Replaces an infinite logit; negated for an opacity of 0. Its opacity, 1 - 2^-23, is as close to 1
# as float32 allows with a gradient.
MAX_LOGIT = 23 * math.log(2)


def write_ply(gaussians: Gaussians, path: Path, normalization: Normalization = IDENTITY) -> None:
    """Write raw parameters as binary float32 in 3DGS's column order, with zero normals; atomic.

    ``normalization`` is undone. Positions far from the origin are written as float64, because
    float32 has steps of half a unit at UTM coordinates. Others stay float32, which every viewer
    reads.
    """
    raw = gaussians.detach().map(lambda tensor: tensor.float().cpu())
    own = raw.means.numpy()
    if not normalization.is_identity:
        own = normalization.undo(own)  # [N, 3]
    table = torch.cat(
        [
            torch.zeros_like(raw.means),
            raw.sh_dc,
            raw.sh_rest.transpose(1, 2).reshape(len(raw), NUM_REST),
            raw.opacity_logits.unsqueeze(-1),
            raw.log_scales - math.log(normalization.scale),
            raw.quaternions,
        ],
        dim=1,
    ).numpy()  # [N, 59]
    far = dict.fromkeys(POSITION, "<f8") if normalization.is_far else {}
    vertices = np.empty(len(raw), list({**dict.fromkeys(COLUMNS, "<f4"), **far}.items()))
    for name, column in zip(COLUMNS, (*own.T, *table.T), strict=True):
        vertices[name] = column
    element = PlyElement.describe(vertices, "vertex")
    with atomic(path, sync=False) as temporary:
        PlyData([element], byte_order="<", comments=[OWN_COMMENT]).write(str(temporary))


def check_ply(path: Path) -> None:
    """Raise InputError if the header or the length of a file shows that it is no readable PLY."""
    _checked(read_header, path)


def _checked(read: Callable[[Path], T], path: Path) -> T:
    """The result of ``read``; an error from damage becomes an InputError with the path."""
    try:
        return read(path)
    except DAMAGE as error:
        raise InputError(f"{path}: not a readable PLY of Gaussians ({error})") from error


def _check_finite(column: Column, name: str, path: Path) -> None:
    with np.errstate(over="ignore"):  # a float64 value may be beyond the range of float32
        (bad,) = np.nonzero(~np.isfinite(column.astype(np.float32)))
    if len(bad):
        raise InputError(
            f"{path}: {name} is not a finite number everywhere: it is {column[bad[0]]} in row "
            f"{bad[0]} and in {len(bad) - 1} more: export the model again"
        )


def _warn_of_activated(vertices: Mapping[str, Column], path: Path) -> None:
    """Log a warning if values look as if 3DGS's activations, exp and sigmoid, were applied."""
    for what, columns, stored in (
        ("scale", SCALES, "logarithms of lengths"),
        ("opacity", ["opacity"], "logits"),
    ):
        if (_stacked(vertices, columns) >= 0).all():
            log.warning(
                "%s: no %s is below 0, and 3DGS stores %s: are the activations applied already?",
                path,
                what,
                stored,
            )


def read_ply(
    path: Path, device: torch.device | str = "cpu", normalization: Normalization = IDENTITY
) -> Gaussians:
    """Read a 3DGS PLY of SH degree 0 to 3 as float32; coefficients above its degree become zero.

    ``normalization`` is applied to positions, before they become float32, and to scales.
    Mip-Splatting's filter is applied, other columns that gsbench does not know are named
    (`gsbench.gaussians.ply_files`).

    Raises InputError if the file is not a PLY, lacks a property, or has invalid values.
    """
    vertices = _read_columns(path)
    rest = [name for name in vertices if name.startswith(REST)]

    def columns(names: Sequence[str]) -> torch.Tensor:
        return torch.from_numpy(_stacked(vertices, names, np.float32)).to(device)

    n, stored = len(vertices["opacity"]), len(rest) // 3  # coefficients per channel
    sh_rest = torch.zeros(n, NUM_SH_REST, 3, device=device)
    if rest:
        sh_rest[:, :stored] = columns(rest).reshape(n, 3, stored).transpose(1, 2)
    means = normalization.apply(_stacked(vertices, POSITION)).astype(np.float32)
    return Gaussians(
        means=torch.from_numpy(means).to(device),
        log_scales=columns(SCALES) + math.log(normalization.scale),
        quaternions=columns(ROTATIONS),
        opacity_logits=columns(["opacity"]).squeeze(-1),
        sh_dc=columns(DC),
        sh_rest=sh_rest,
    )


def _stacked(
    vertices: Mapping[str, Column], names: Sequence[str], kind: type[np.floating] = np.float64
) -> Column:
    return np.stack([vertices[name].astype(kind) for name in names], axis=1)  # [N, K]


def _read_columns(path: Path) -> dict[str, Column]:
    """The columns of a 3DGS PLY, with valid values; raises as `read_ply` does."""
    content, table = _checked(read_ply_data, path)
    names = _check_properties(table, path)
    vertices: dict[str, Column] = {name: table[name] for name in names}
    opacity = vertices["opacity"]
    if count := int(np.isinf(opacity).sum()):  # other programs write them for 0 and 1
        have = "has" if count == 1 else "have"
        log.warning(
            "%s: %s %s an opacity of exactly 0 or 1", path, counted(count, "Gaussian"), have
        )
        vertices["opacity"] = np.where(np.isinf(opacity), np.sign(opacity) * MAX_LOGIT, opacity)
    for name, column in vertices.items():
        _check_finite(column, name, path)
    if not _stacked(vertices, ROTATIONS).any(axis=1).all():
        raise InputError(
            f"{path}: a Gaussian has a rotation of (0, 0, 0, 0): export the model again"
        )
    if OWN_COMMENT not in content.comments:
        _warn_of_activated(vertices, path)
        report_header([*content.comments, *content.obj_info], path)
    for name in [name for name in table.dtype.names or () if is_filter(name)][:1]:
        logits, sizes = _stacked({**vertices, name: table[name]}, ["opacity", name]).T
        scales, logits = filtered(_stacked(vertices, SCALES), logits, sizes, path)
        vertices |= dict(zip(SCALES, scales.T, strict=True))
        vertices["opacity"] = logits.clip(-MAX_LOGIT, MAX_LOGIT)
    return vertices


def _check_properties(vertices: Any, path: Path) -> list[str]:
    """The names of the columns to read.

    Raises InputError unless the properties are those of a 3DGS PLY.
    """
    present = vertices.dtype.names or ()
    check_columns(present, COLUMNS, path)
    present_rest = {name for name in present if name.startswith(REST)}
    rest = [f"{REST}{i}" for i in range(len(present_rest))]
    missing = [name for name in REQUIRED if name not in present]
    odd = present_rest - set(rest)
    if odd or len(rest) not in REST_COUNTS:
        example = f", with {min(odd)}" if odd else ""
        raise InputError(
            f"{path}: not a 3DGS PLY; its harmonics must be f_rest_0 to 8, to 23 or to 44 (degree "
            f"1 to 3), or none; it has {len(rest)}{example}"
        )
    if missing or len(vertices) == 0:
        listed = ", ".join(missing) or "all, since it is empty"
        is_cloud = set(present) >= set(POSITION) and "f_dc_0" in missing
        hint = ": it is a point cloud, which init=points reads" if is_cloud else ""
        if missing == ["scale_2"]:
            hint = ": it has flat Gaussians (2DGS), and gsbench draws 3D Gaussians alone"
        raise InputError(f"{path}: not a 3DGS PLY; missing or odd properties: {listed}{hint}")
    names = [*REQUIRED, *rest]
    for name in names:
        kind = vertices.dtype[name].kind
        if kind not in "fiu":  # a list
            raise InputError(f"{path}: {name} is not a number: export the model again")
        if kind != "f" and name not in POSITION:
            raise InputError(
                f"{path}: {name} has whole numbers, as in a compressed model: export it with "
                "floating-point numbers"
            )
    return names
