"""The PLY file of 3DGS, which viewers and other trainers read."""

import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyProperty

from gsbench.errors import InputError
from gsbench.files import DAMAGE, atomic, require_regular
from gsbench.gaussians.model import MAX_SH_DEGREE, NUM_SH_REST, Gaussians
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
COLUMNS = [
    *[*POSITION, "nx", "ny", "nz", *DC, *[f"{REST}{i}" for i in range(NUM_REST)]],
    *["opacity", *SCALES, *ROTATIONS],
]
Column = NDArray[Any]  # [N]
Columns = dict[str, Column]

# Marks files of gsbench, whose values need no doubt.
OWN_COMMENT = "written by gsbench"

REST_COUNTS = tuple(3 * ((degree + 1) ** 2 - 1) for degree in range(MAX_SH_DEGREE + 1))
# Replaces an infinite logit; negated for an opacity of 0. Its opacity, 1 - 2^-23, is as close to 1
# as float32 allows with a gradient.
MAX_LOGIT = 23 * math.log(2)
# typical scale of a Gaussian over the size of its model; medians of trained models: 0.009 to 0.035
TYPICAL_SCALE = 0.02
MIN_TEXT_BYTES = 2  # minimum bytes of a value in an ASCII file: a digit and a space


def write_ply(gaussians: Gaussians, path: Path, normalization: Normalization = IDENTITY) -> None:
    """Write raw parameters as binary float32 in 3DGS's column order, with zero normals; atomic.

    ``normalization`` is undone. Positions far from the origin are written as float64, because
    float32 has steps of half a unit at UTM coordinates. Others stay float32, which every viewer
    reads.
    """
    raw = gaussians.detach().map(lambda tensor: tensor.float().cpu())
    table = torch.cat(
        [
            raw.means,
            torch.zeros_like(raw.means),
            raw.sh_dc,
            raw.sh_rest.transpose(1, 2).reshape(len(raw), NUM_REST),
            raw.opacity_logits.unsqueeze(-1),
            raw.log_scales - math.log(normalization.scale),
            raw.quaternions,
        ],
        dim=1,
    ).numpy()  # [N, 62]
    types = dict.fromkeys(COLUMNS, "<f4")
    vertices = np.ascontiguousarray(table, dtype="<f4").view(list(types.items())).reshape(len(raw))
    if not normalization.is_identity:
        if normalization.is_far:
            types |= dict.fromkeys(POSITION, "<f8")
        vertices = vertices.astype(list(types.items()))
        own = normalization.undo(raw.means.numpy())  # [N, 3]
        for axis, name in enumerate(POSITION):
            vertices[name] = own[:, axis]
    element = PlyElement.describe(vertices, "vertex")
    with atomic(path, sync=False) as temporary:
        PlyData([element], byte_order="<", comments=[OWN_COMMENT]).write(str(temporary))


def check_ply(path: Path) -> None:
    """Raise InputError if the header or the length of a file shows that it is no readable PLY."""
    with _checked(path):
        pass


@contextmanager
def _checked(path: Path) -> Iterator[None]:
    """Check a file's length, and turn any error from damage into an InputError with its path."""
    try:
        _check_length(path)
        yield
    except DAMAGE as error:
        raise InputError(f"{path}: not a readable PLY of Gaussians ({error})") from error


def _check_length(path: Path) -> None:
    """Raise ValueError if the header announces more data than the file can hold."""
    # plyfile allocates memory for the announced data before it reads: a wrong count could fill the
    # memory.
    require_regular(path)
    header = read_header(path)
    is_text = b"format ascii" in header
    announced = count = 0  # announced: bytes
    for line in header.decode("ascii", errors="replace").splitlines():
        words = line.split()
        if words[:1] == ["element"]:
            count = int(words[2])
            if count < 0:
                raise ValueError("the count of an element is negative")
        elif words[:1] == ["property"]:
            announced += count * (MIN_TEXT_BYTES if is_text else _bytes_of(words[1]))
    if announced > path.stat().st_size:
        raise ValueError(f"it is cut short: its header promises {announced} bytes or more")


def _bytes_of(kind: str) -> int:
    """The bytes of a value of a PLY's type; of a list, those of its length at least."""
    return 1 if kind == "list" else np.dtype(PlyProperty("", kind).dtype()).itemsize


def _finite_logits(logits: Column, path: Path) -> Column:
    """Replace infinite logits by plus or minus `MAX_LOGIT`, with a warning.

    Other programs write them for opacities of exactly 0 and 1.
    """
    infinite = np.isinf(logits) if logits.dtype.kind == "f" else np.zeros(len(logits), bool)
    if not infinite.any():
        return logits
    count = int(infinite.sum())
    have = "has" if count == 1 else "have"
    log.warning("%s: %s %s an opacity of exactly 0 or 1", path, counted(count, "Gaussian"), have)
    return np.where(infinite, np.sign(logits) * MAX_LOGIT, logits)


def _check_finite(column: Column, name: str, path: Path) -> None:
    where = ""
    if column.dtype.kind in "fiu":
        with np.errstate(over="ignore"):  # a float64 value may be beyond the range of float32
            (bad,) = np.nonzero(~np.isfinite(column.astype(np.float32)))
        if not len(bad):
            return
        where = f": it is {column[bad[0]]} in row {bad[0]} and in {len(bad) - 1} more"
    raise InputError(
        f"{path}: {name} is not a finite number everywhere{where}: export the model again"
    )


def _warn_of_activated(vertices: Columns, path: Path) -> None:
    """Log a warning if values look as if 3DGS's activations, exp and sigmoid, were applied."""
    if _look_like_lengths(vertices):
        log.warning(
            "%s: all scales are positive: they look like lengths, where 3DGS stores their "
            "logarithms",
            path,
        )
    opacity = vertices["opacity"]
    # As logits, half of all opacities would be 1 to seven digits: then they are bytes.
    for most, is_activated in ((1, opacity.max() <= 1), (255, np.median(opacity) > MAX_LOGIT)):
        if opacity.min() >= 0 and is_activated:
            log.warning(
                "%s: all opacities lie in [0, %d]: they look like opacities, where 3DGS stores "
                "their logits",
                path,
                most,
            )


def _look_like_lengths(vertices: Columns) -> bool:
    """Return whether the stored scales are more plausible as lengths than as logarithms of lengths.

    The sign does not decide: in a scene measured in millimetres, all logarithms can be positive.
    """
    scales, positions = (
        np.stack([vertices[name] for name in names]).astype(np.float64)  # [3, N]
        for names in (SCALES, POSITION)
    )
    if not (scales > 0).all():
        return False
    offsets = positions - np.median(positions, axis=1, keepdims=True)
    size = float(np.median(np.linalg.norm(offsets, axis=0)))
    if size == 0:
        return False
    typical, scale = math.log(TYPICAL_SCALE * size), float(np.median(scales))
    return abs(math.log(scale) - typical) < abs(scale - typical)


def read_ply(
    path: Path, device: torch.device | str = "cpu", normalization: Normalization = IDENTITY
) -> Gaussians:
    """Read a 3DGS PLY of SH degree 0 to 3 as float32; coefficients above its degree become zero.

    ``normalization`` is applied to positions, before they become float32, and to scales.
    Mip-Splatting's filter is applied, other columns that gsbench does not know are named
    (`gsbench.gaussians.ply_files`).

    Raises InputError if the file is not a PLY, lacks a property, or has invalid values.
    """
    with _checked(path):
        content = read_ply_data(path)
        table = content["vertex"].data
    rest = _check_properties(table, path)
    vertices = {name: table[name] for name in (*REQUIRED, *rest)}
    vertices["opacity"] = _finite_logits(vertices["opacity"], path)
    for name, column in vertices.items():
        _check_finite(column, name, path)
    if not np.any([vertices[name] != 0 for name in ROTATIONS], axis=0).all():
        raise InputError(
            f"{path}: a Gaussian has a rotation of (0, 0, 0, 0): export the model again"
        )
    if OWN_COMMENT not in content.comments:
        _warn_of_activated(vertices, path)
        names = [element.name for element in content]
        report_header([*content.comments, *content.obj_info], names, path)
    if sizes := [name for name in table.dtype.names if is_filter(name)]:
        vertices |= filtered(vertices, SCALES, table[sizes[0]], path, MAX_LOGIT)

    def columns(names: Sequence[str]) -> torch.Tensor:
        stacked = np.stack([vertices[name].astype(np.float32) for name in names], axis=1)
        return torch.from_numpy(stacked).to(device)

    positions = np.stack([vertices[name] for name in POSITION], axis=1)  # [N, 3]
    n, stored = len(table), len(rest) // 3  # coefficients per channel
    sh_rest = torch.zeros(n, NUM_SH_REST, 3, device=device)
    if stored:
        sh_rest[:, :stored] = columns(rest).reshape(n, 3, stored).transpose(1, 2)
    return Gaussians(
        means=torch.from_numpy(normalization.apply(positions).astype(np.float32)).to(device),
        log_scales=columns(SCALES) + math.log(normalization.scale),
        quaternions=columns(ROTATIONS),
        opacity_logits=columns(["opacity"]).squeeze(-1),
        sh_dc=columns(DC),
        sh_rest=sh_rest,
    )


def _check_properties(vertices: Any, path: Path) -> list[str]:
    """The names of the harmonics above degree 0.

    Raises InputError unless the properties are those of a 3DGS PLY.
    """
    present = set(vertices.dtype.names or ())
    check_columns(vertices.dtype.names or (), COLUMNS, path)
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
        is_cloud = present >= set(POSITION) and "f_dc_0" in missing
        hint = ": it is a point cloud, which init=points reads" if is_cloud else ""
        if missing == ["scale_2"]:
            hint = ": it has flat Gaussians (2DGS), and gsbench draws 3D Gaussians alone"
        raise InputError(f"{path}: not a 3DGS PLY; missing or odd properties: {listed}{hint}")
    for name in (*REQUIRED, *rest):
        if name not in POSITION and vertices.dtype[name].kind in "iu":
            raise InputError(
                f"{path}: {name} has whole numbers, as in a compressed model: export it with "
                "floating-point numbers"
            )
    return rest
