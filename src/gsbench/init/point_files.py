"""Reading clouds of points: PLY files of any program, and tables of numbers as text."""

import io
import logging
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.files import DAMAGE, require_regular
from gsbench.gaussians.ply_files import read_ply_data, recognised_format
from gsbench.parsing import one_line, without_byte_order_mark
from gsbench.scene.types import Array, ByteArray

log = logging.getLogger(__name__)

Columns = Mapping[str, NDArray[np.generic]]  # [P] by the names in the file

DC_NAMES = ("f_dc_0", "f_dc_1", "f_dc_2")
SH_C0 = 0.5 / math.sqrt(math.pi)  # the constant spherical harmonic, by which 3DGS multiplies f_dc
TEXT_SUFFIXES = (".xyz", ".txt", ".csv", ".pts", ".asc")
COLOR_NAMES = (("red", "green", "blue"), ("r", "g", "b"))
WITHOUT_COLOR = frozenset(("x", "y", "z", "nx", "ny", "nz"))
# Before the name of a column: CloudCompare writes colours that it computed as scalar_R.
PREFIX = re.compile(
    r"^(pos(ition)?|coord(inate)?|point|vertex|colou?r|rgb|diffuse|ambient|scalar)(?=[\W_])"
)
# Columns of a table without names, by their number.
LAYOUTS = {3: "x y z", 6: "x y z red green blue"}
# scanners write the intensity before the colour
PTS_LAYOUTS = LAYOUTS | {4: "x y z intensity", 7: "x y z intensity red green blue"}
# Colours up to this are fractions, even if tone mapping or rounding went beyond 1. As bytes they
# would all be black.
MAX_FRACTION = 2.0
ROW = re.compile(r'"?[-+]?(\.?\d[\d.]*(e[-+]?\d+)?|nan|inf(inity)?)"?(?=[\s,;]|$)', re.I)
NO_ROW = re.compile(r"\d+$|#|//")  # a count of points, or a comment
OF_COLMAP = "it belongs to a COLMAP model: init=dataset reads its folder"
REMEDY = (
    "wanted are rows of x y z [red green blue] with decimal points, below a first line such as "
    "x,y,z,red,green,blue if there are other columns: save it so, or as PLY with CloudCompare"
)


def read_points(path: Path) -> tuple[Array, ByteArray | None]:
    """Read points [P, 3] float64 and colours [P, 3], or None for a file without colours.

    The suffix tells the format. A ``.ply`` file, text or binary, has vertices with x, y, z in any
    order and type, and colours as whole numbers or in [0, 1]. A text file has the columns that its
    first line names, else those of `LAYOUTS`. Raises ``InputError`` for a file that cannot be read,
    holds no point, or has a coordinate or colour that is not a finite number.
    """
    suffix = path.suffix.lower()
    require_regular(path)
    try:
        if suffix == ".ply":
            _, vertices = read_ply_data(path)
            columns: Columns = {name: vertices[name] for name in vertices.dtype.names or ()}
        elif suffix in TEXT_SUFFIXES:
            columns = _read_table(path)
        else:
            raise ValueError(_other_format(path))
        points, colors = _points_and_colors(columns, path)
    except DAMAGE as error:
        raise InputError(
            f"{path}: not a readable file of points ({one_line(str(error))})"
        ) from error
    if len(points) == 0:
        raise InputError(f"{path}: holds no point")
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise InputError(
            f"{path}: {bad.sum():,} of {len(points):,} points have coordinates that are not "
            "finite numbers"
        )
    if colors is None:
        return points, None
    if not np.isfinite(colors.astype(np.float64)).all() or colors.min() < 0:
        raise InputError(f"{path}: has colours that are negative or not finite numbers")
    return points, _eight_bits(colors)


def _other_format(path: Path) -> str:
    if path.stem in ("points3D", "images", "cameras"):
        return OF_COLMAP
    if kind := recognised_format(path):
        return f"it is {kind}"
    known = ", ".join((".ply", *TEXT_SUFFIXES))
    return f"known are {known}: convert it to PLY, for example with CloudCompare"


def _read_table(path: Path) -> Columns:
    """Read rows of numbers; raises ValueError for other tables.

    Names may come first, also behind ``//`` or ``#``. A line of one number is the count of points,
    with which each scan of a ``.pts`` file begins.
    """
    import pandas as pd  # here, since it is slow to import

    text = without_byte_order_mark(path.read_bytes()).decode(errors="replace")
    if "POINT3D_ID" in text[:1000]:
        raise ValueError(OF_COLMAP)
    lines = [line.strip(" \t,;") for line in text.splitlines() if line.strip()]
    first = next((k for k, line in enumerate(lines) if ROW.match(line)), len(lines))
    rows = [line for line in lines[first:] if not NO_ROW.match(line)]
    if not rows:
        raise ValueError(f"no line is a row of numbers: {REMEDY}")
    between = next((mark for mark in ",;" if mark in rows[0]), r"\s+")
    try:
        table = pd.read_csv(io.StringIO("\n".join(rows)), sep=between, header=None)
        values = table.to_numpy(dtype=np.float64)  # [P, columns]
    except ValueError as error:  # pandas' errors are
        raise ValueError(f"{error}; {REMEDY}") from error
    head, count = lines[first - 1].strip(" \t,;/#") if first else "", values.shape[1]
    words = re.split("[,;]" if re.search("[,;]", head) else r"\s+", head)
    if len(words) != count:
        layouts = PTS_LAYOUTS if path.suffix.lower() == ".pts" else LAYOUTS
        words = layouts.get(count, "").split()
    if not words:
        raise ValueError(f"it has {count} columns without names: {REMEDY}")
    return {word.strip(" \t\"'"): column for word, column in zip(words, values.T, strict=True)}


def _points_and_colors(columns: Columns, path: Path) -> tuple[Array, NDArray[np.generic] | None]:
    """Points [P, 3] and colours [P, 3], or None, from columns with any of the known names.

    One log line names the columns that are not used if there is no colour.
    """

    def stacked(names: Iterable[str]) -> NDArray[np.generic]:
        return np.stack([known[name] for name in names], axis=1)

    known = {_plain(name): column for name, column in columns.items()}
    known |= {name.lower(): column for name, column in columns.items()}
    if lacking := [name for name in "xyz" if name not in known]:
        raise ValueError(f"it has no column {', '.join(lacking)}: {REMEDY}")
    points = stacked("xyz").astype(np.float64)
    if known.keys() >= {*DC_NAMES}:  # a model of Gaussians
        dc = stacked(DC_NAMES).astype(np.float64)
        return points, np.clip(0.5 + SH_C0 * dc, 0.0, 1.0)  # NaN stays; `read_points` refuses it
    for group in COLOR_NAMES:
        if known.keys() >= {*group}:
            return points, stacked(group)
    if others := [name for name in columns if _plain(name) not in WITHOUT_COLOR]:
        log.warning(
            "%s: it has no red, green and blue, and its %s is not used", path, ", ".join(others)
        )
    return points, None


def _plain(word: str) -> str:
    """The name of a column without its unit: ``x`` for ``X [m]``, ``r`` for ``Color R``."""
    name = PREFIX.sub("", re.sub(r"[\[(].*", "", word.lower()).strip())
    name = re.sub(r"[^a-z_]", "", name).strip("_")
    return name[0] if name in ("rf", "gf", "bf") else name  # as CloudCompare writes


def _eight_bits(colors: NDArray[np.generic]) -> ByteArray:
    """Colours from 0 to 255: 16-bit values are divided by 257, fractions multiplied by 255."""
    values = colors.astype(np.float64)
    is_whole = values.max() > 1 and (values == values.round()).all()
    if colors.dtype.kind == "f" and values.max() <= MAX_FRACTION and not is_whole:
        values = values * 255
    elif values.max() > 255:
        values = values / 257  # 65535 becomes 255
    return values.round().clip(0, 255).astype(np.uint8)
