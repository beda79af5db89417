"""PLY files of other programs: how they are read, formats that are no PLY, and unknown columns."""

import io
import logging
import re
from collections.abc import Collection, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyParseError, PlyProperty

from gsbench.errors import InputError
from gsbench.files import GIT_LFS, LFS_REMEDY, require_regular

log = logging.getLogger(__name__)

MAX_HEADER = 1 << 16  # bytes
END = b"end_header"
MIN_TEXT_BYTES = 2  # minimum bytes of a value in an ASCII file: a digit and a space
NOT_ASCII = re.compile(rb"[^\x00-\x7f]")
CHECKPOINT = "a checkpoint of PyTorch: give the PLY that its trainer wrote or exports"
UNPACK = "unpack it with npx @playcanvas/splat-transform {name} out.ply"
# Files that are no PLY: endings, first bytes, and what they are. NGSP begins a file of SPZ 3 or
# newer; older ones are compressed by gzip.
OTHER_FORMATS: list[tuple[tuple[str, ...], tuple[bytes, ...], str]] = [
    ((), (GIT_LFS,), LFS_REMEDY),
    ((".pth", ".pt", ".ckpt"), (b"\x80",), CHECKPOINT),
    ((".splat", ".ksplat", ".spz", ".sog"), (b"NGSP",), f"a packed model: {UNPACK}"),
    ((), (b"PK\x03\x04",), "a ZIP archive: unpack it, and give the PLY in it"),
    ((), (b"\x1f\x8b",), "compressed by gzip: gunzip {name}"),
    ((), (b"{",), "JSON: give the PLY of a model"),
]


def read_header(path: Path) -> bytes:
    """Return the header of a PLY without its last line.

    Raises ValueError if there is none, with the name of another format of Gaussians, or if it
    announces more data than the file can hold; and InputError for a pipe or a device.
    """
    require_regular(path)
    with path.open("rb") as stream:
        start = stream.read(MAX_HEADER)
    if not start.startswith(b"ply") and (kind := _other_format(path, start)):
        raise ValueError(f"it is {kind}")
    header, end, _ = start.partition(END)
    if not end:
        raise ValueError("it has no header")
    if b"element chunk" in header and b"packed_position" in header:
        unpack = UNPACK.format(name=path.name)
        raise ValueError(f"it is a compressed PLY, as SuperSplat writes it: {unpack}")
    _check_length(header, path.stat().st_size)
    return header


def _check_length(header: bytes, size: int) -> None:
    # plyfile allocates memory for the announced data before it reads: a wrong count could fill the
    # memory.
    announced = count = 0  # announced: bytes
    for line in header.decode("ascii", errors="replace").splitlines():
        match line.split():
            case ["element", _, number, *_]:
                count = int(number)
                if count < 0:
                    raise ValueError("the count of an element is negative")
            case ["element", *_]:
                raise ValueError("an element has no count")
            case ["property", kind, *_] if b"format ascii" in header:
                announced += count * MIN_TEXT_BYTES
            case ["property", kind, *_]:  # of a list, at least the byte of its length
                kind = "char" if kind == "list" else kind
                announced += count * np.dtype(PlyProperty("", kind).dtype()).itemsize
    if announced > size:
        raise ValueError(f"it is cut short: its header promises {announced} bytes or more")


def recognised_format(path: Path) -> str:
    """Describe the file of a format that is no PLY, and what to do; else ""."""
    with path.open("rb") as stream:
        return _other_format(path, stream.read(MAX_HEADER))


def _other_format(path: Path, start: bytes) -> str:
    """Describe a file that is no PLY by its name and its first bytes, and what to do; else ""."""
    for endings, magic, words in OTHER_FORMATS:
        if path.name.lower().endswith(endings) or start.startswith(magic):
            return words.format(name=path.name)
    return ""


def read_ply_data(path: Path) -> tuple[PlyData, NDArray[Any]]:
    """Return the content of a PLY file, and the table of its vertices.

    Unlike plyfile, it accepts comments with characters beyond ASCII. Raises as `read_header` does,
    ValueError without vertices, and other errors of `gsbench.files.DAMAGE`.
    """
    header = read_header(path)
    source: Any = str(path)
    if not header.isascii():
        source = io.BytesIO(NOT_ASCII.sub(b"?", header) + path.read_bytes()[len(header) :])
    try:
        data = PlyData.read(source)
    except PlyParseError as error:
        raise ValueError(str(error)) from error
    if "vertex" not in data:
        elements = ", ".join(element.name for element in data)
        raise ValueError(f"it has no element vertex, only {elements or 'a header'}")
    return data, data["vertex"].data


FILTER = "filter_3D"
MOVING = "its Gaussians move with time"
# Names of columns in lower case, and why a model with them is no set of 3D Gaussians that stand
# still.
REFUSED = {
    r"betas?(_\d+)?|sb_params_\d+": "Beta Splatting's kernels are no Gaussians",
    r"nu_degree|nu": "kernels of Student Splatting are no Gaussians",
    r"shapes?(_\d+)?": "generalised exponentials (GES) are no Gaussians",
    r"t|time|t_\w+|scale_t|rot_[rt]_\d|trbf_\w+|motion_\d+|omega_\d+|velocity_\w+": MOVING,
    r"f_anchor_feat_\d+|f_offset_\d+": "Scaffold-GS computes its Gaussians by networks",
    r"f_asg_\d+": "Spec-Gaussian computes its colours by networks",
}
# Found so in exports, and without effect on a render of f_dc and f_rest.
HARMLESS = re.compile("red|green|blue")


# Comments in a PLY's header. Brush writes SplatRenderMode, Postshot antialiased.
ANTIALIASED = re.compile(r"SplatRenderMode:\s*mip|(antialiased|anti.?aliasing)\W*(1|true)", re.I)


def report_header(comments: Sequence[str], path: Path) -> None:
    """Log a warning if a comment in the header says that the model is for another rasterizer."""
    for comment in filter(ANTIALIASED.search, comments):
        log.warning(
            "%s: %r: its opacities belong to an antialiased rasterizer (Mip-Splatting); gsbench "
            "draws them without it, and thin Gaussians come out too opaque",
            path,
            comment,
        )


def check_columns(names: Collection[str], known: Collection[str], path: Path) -> None:
    """Raise InputError for a column that changes what is drawn; log those that are not known."""
    unknown = [
        name
        for name in names
        if name not in known and not HARMLESS.fullmatch(name) and not is_filter(name)
    ]
    for name, (pattern, reason) in product(unknown, REFUSED.items()):
        if re.fullmatch(pattern, name.lower()):
            raise InputError(
                f"{path}: it has the column {name}: {reason}, and gsbench draws Gaussians alone"
            )
    if unknown:
        log.warning("%s: not known and not used: column %s", path, ", ".join(unknown))


def is_filter(name: str) -> bool:
    """Return whether a column holds the sizes of Mip-Splatting's 3D filter."""
    return name.lower() == FILTER.lower()


def filtered(
    logs: NDArray[Any], logits: NDArray[Any], sizes: NDArray[Any], path: Path
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Log scales [N, 3] and opacities' logits [N] after Mip-Splatting's 3D filter; logs a line.

    As its ``create_fused_ply.py``: each scale s becomes sqrt(s² + f²) for the filter's ``sizes``
    [N], and the opacity is multiplied by the ratio of the volumes before and after (Yu et al. 2024,
    equation 7).
    """
    if not (np.isfinite(sizes) & (sizes >= 0)).all():
        raise InputError(f"{path}: {FILTER} is negative or not a finite number: export it again")
    log.warning("%s: Mip-Splatting's %s is applied to scales and opacities", path, FILTER)
    with np.errstate(divide="ignore"):
        fused = 0.5 * np.logaddexp(2 * logs, 2 * np.log(sizes[:, None]))  # log sqrt(s² + f²)
        # log of the new opacity, then its logit: log p - log(1 - p)
        log_opacity = -np.logaddexp(0.0, -logits) + (logs - fused).sum(axis=1)
        return fused, log_opacity - np.log(-np.expm1(np.minimum(log_opacity, 0.0)))
