"""Reading clouds of points: PLY files of any program, and tables of numbers as text."""

import io
import logging
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.files import DAMAGE, require_regular
from gsbench.gaussians.ply_files import read_ply_data, recognised_format
from gsbench.parsing import one_line, without_byte_order_mark
from gsbench.scene.types import Array

log = logging.getLogger(__name__)

DC_NAMES = ("f_dc_0", "f_dc_1", "f_dc_2")
SH_C0 = 0.5 / math.sqrt(math.pi)  # the constant spherical harmonic, by which 3DGS multiplies f_dc
TEXT_SUFFIXES = (".xyz", ".txt", ".csv", ".pts", ".asc")
COLOR_NAMES = (("red", "green", "blue"), ("r", "g", "b"))
WITHOUT_COLOR = frozenset(("x", "y", "z", "nx", "ny", "nz"))
# Before the name of a column: CloudCompare writes colours that it computed as scalar_R.
PREFIX = re.compile(
    r"^(pos(ition)?|coord(inate)?|point|vertex|colou?r|rgb|diffuse|ambient|scalar)(?=[\W_])"
)
# Columns of red, green and blue in a table without names, by its number of columns.
COLORS = {3: [], 6: [3, 4, 5]}
PTS_COLORS = COLORS | {4: [], 7: [4, 5, 6]}  # scanners write the intensity before the colour
# Colours up to this are fractions, even if tone mapping or rounding went beyond 1. As bytes they
# would all be black.
MAX_FRACTION = 2.0
REMEDY = (
    "wanted are rows of x y z [red green blue] with decimal points, below a first line such as "
    "x,y,z,red,green,blue if there are other columns: save it so, or as PLY with CloudCompare"
)


def read_points(path: Path) -> tuple[Array, NDArray[np.uint8] | None]:
    """Read points [P, 3] float64 and colours [P, 3], or None for a file without colours.

    The suffix tells the format. A ``.ply`` file, text or binary, has vertices with x, y, z in any
    order and type, and colours as whole numbers or in [0, 1]. A text file has the columns that its
    first line names, else those of `COLORS`. Raises ``InputError`` for a file that cannot be read,
    holds no point, or has a coordinate or colour that is not a finite number.
    """
    suffix = path.suffix.lower()
    require_regular(path)
    try:
        if suffix == ".ply":
            points, colors = _read_ply(path)
        elif suffix in TEXT_SUFFIXES:
            points, colors = _read_table(path)
        else:
            raise ValueError(_other_format(path))
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
        return "it belongs to a COLMAP model: init=dataset reads its folder"
    if kind := recognised_format(path):
        return f"it is {kind}"
    known = ", ".join((".ply", *TEXT_SUFFIXES))
    return f"known are {known}: convert it to PLY, for example with CloudCompare"


def _read_ply(path: Path) -> tuple[Array, NDArray[np.generic] | None]:
    content = read_ply_data(path)
    if "vertex" not in content:
        elements = ", ".join(element.name for element in content)
        raise ValueError(f"it has no element vertex, only {elements or 'a header'}")
    vertices = content["vertex"].data
    written = vertices.dtype.names or ()
    names = {_plain(name): name for name in written} | {name.lower(): name for name in written}
    if lacking := [name for name in "xyz" if name not in names]:
        raise ValueError(f"its vertices have no property {', '.join(lacking)}")

    def columns(wanted: Iterable[str]) -> NDArray[np.generic]:
        return np.stack([vertices[names[name]] for name in wanted], axis=1)

    points = columns("xyz").astype(np.float64)
    if set(DC_NAMES) <= set(written):  # a model of Gaussians
        dc = np.stack([vertices[name] for name in DC_NAMES], axis=1).astype(np.float64)
        return points, np.clip(0.5 + SH_C0 * dc, 0.0, 1.0)  # NaN stays; `read_points` refuses it
    colored = _color_names(names, path)
    return points, columns(colored) if colored else None


def _read_table(path: Path) -> tuple[Array, Array | None]:
    """Read points [P, 3] and colours [P, 3], or None, from rows of numbers.

    Names may come first, also behind ``//`` or ``#``. A line of one number is the count of points,
    with which each scan of a ``.pts`` file begins. Raises ValueError for other tables.
    """
    text = without_byte_order_mark(path.read_bytes()).decode(errors="replace")
    if "POINT3D_ID" in text[:1000]:
        raise ValueError("it belongs to a COLMAP model: init=dataset reads its folder")
    lines = [line.strip(" \t,;") for line in text.splitlines() if line.strip()]
    first = next((k for k, line in enumerate(lines) if _is_row(line)), len(lines))
    titles, rows = lines[:first], [line for line in lines[first:] if not _is_aside(line)]
    if not rows:
        raise ValueError(f"no line is a row of numbers: {REMEDY}")
    between = next((mark for mark in ",;" if mark in rows[0]), r"\s+")
    try:
        table = pd.read_csv(io.StringIO("\n".join(rows)), sep=between, header=None).to_numpy(
            dtype=np.float64
        )  # [P, columns]
    except ValueError as error:  # pandas' errors are
        raise ValueError(f"{error}; {REMEDY}") from error
    count = table.shape[1]
    written = _words(titles[-1]) if titles else []
    if len(written) == count:
        columns = {_plain(word): k for k, word in enumerate(written)}
        if not columns.keys() >= set("xyz"):
            raise ValueError(f"none of its columns are called x, y and z: {REMEDY}")
        names = dict(zip(columns, written, strict=False))
        colors = [columns[name] for name in _color_names(names, path)]
        return table[:, [columns[axis] for axis in "xyz"]], table[:, colors] if colors else None
    layouts = PTS_COLORS if path.suffix.lower() == ".pts" else COLORS
    if count not in layouts:
        raise ValueError(f"it has {count} columns without names: {REMEDY}")
    return table[:, :3], table[:, layouts[count]] if layouts[count] else None


def _words(line: str) -> list[str]:
    line = line.strip(" \t,;/#")
    words = re.split(r"[,;]" if "," in line or ";" in line else r"\s+", line)
    return [word.strip(" \t\"'") for word in words]


def _is_aside(line: str) -> bool:
    return line.isdecimal() or line.startswith(("#", "//"))  # a count of points, or a comment


def _is_row(line: str) -> bool:
    try:
        float(_words(line)[0])
    except ValueError:
        return False
    return not line.startswith(("#", "//"))


def _plain(word: str) -> str:
    """The name of a column without its unit: ``x`` for ``X [m]``, ``r`` for ``Color R``."""
    name = PREFIX.sub("", re.sub(r"[\[(].*", "", word.lower()).strip())
    name = re.sub(r"[^a-z_]", "", name).strip("_")
    return name[0] if name in ("rf", "gf", "bf") else name  # as CloudCompare writes


def _color_names(names: Mapping[str, str], path: Path) -> tuple[str, ...]:
    """The plain names of red, green and blue among ``names``, plain and as written; () if none.

    Then one log line names the columns that are not used.
    """
    for group in COLOR_NAMES:
        if names.keys() >= set(group):
            return group
    if others := [written for name, written in names.items() if name not in WITHOUT_COLOR]:
        log.warning(
            "%s: it has no red, green and blue, and its %s is not used", path, ", ".join(others)
        )
    return ()


def _eight_bits(colors: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Colours from 0 to 255: 16-bit values are divided by 257, fractions multiplied by 255."""
    values = colors.astype(np.float64)
    is_whole = values.max() > 1 and (values == values.round()).all()
    if colors.dtype.kind == "f" and values.max() <= MAX_FRACTION and not is_whole:
        values = values * 255
    elif values.max() > 255:
        values = values / 257  # 65535 becomes 255
    return values.round().clip(0, 255).astype(np.uint8)
