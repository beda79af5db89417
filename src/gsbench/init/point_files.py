"""Reading clouds of points: PLY files of any program, and tables of numbers as text."""

import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.files import require_regular
from gsbench.gaussians.ply_files import read_ply_data
from gsbench.parsing import one_line, without_byte_order_mark
from gsbench.scene.types import Array

COLOR_NAMES = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
DC_NAMES = ("f_dc_0", "f_dc_1", "f_dc_2")
SH_C0 = 0.5 / math.sqrt(math.pi)  # the constant spherical harmonic, by which 3DGS multiplies f_dc
TEXT_SUFFIXES = (".xyz", ".txt", ".csv", ".pts", ".asc")
# Columns of red, green and blue in a table without names, by its number of columns; the likelier
# first. The first three are x, y, z. Scanners write an intensity before the colour, other programs
# a value after it; programs for meshes write normals.
LAYOUTS: dict[int, tuple[tuple[int, ...], ...]] = {
    3: ((),),
    4: ((),),
    6: ((3, 4, 5), ()),
    7: ((4, 5, 6), (3, 4, 5)),
    9: ((3, 4, 5), (6, 7, 8)),
    10: ((4, 5, 6), (3, 4, 5)),
}
DECIMAL_COMMAS = re.compile(r"-?\d+,\d+([\s;]+-?\d+,\d+)+")
UNIT = 0.01  # the length of a normal written with few digits differs from 1 by less


def read_points(path: Path) -> tuple[Array, NDArray[np.uint8] | None]:
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
            points, colors = _read_ply(path)
        elif suffix in TEXT_SUFFIXES:
            content = without_byte_order_mark(path.read_bytes())
            points, colors = _read_text(content.decode(errors="replace"))
        else:
            raise ValueError(f"known are .ply, {', '.join(TEXT_SUFFIXES)}")
    # readers may raise any exception on a damaged file, numpy even tokenizer errors
    except Exception as error:
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


def _read_ply(path: Path) -> tuple[Array, NDArray[np.generic] | None]:
    vertices = read_ply_data(path)["vertex"].data
    present = set(vertices.dtype.names or ())
    if lacking := [name for name in "xyz" if name not in present]:
        raise ValueError(f"its vertices have no property {', '.join(lacking)}")

    def columns(names: Iterable[str]) -> NDArray[np.generic]:
        return np.stack([vertices[name] for name in names], axis=1)

    points = np.stack([vertices[name].astype(np.float64) for name in "xyz"], axis=1)
    for names in COLOR_NAMES:
        if present.issuperset(names):
            return points, columns(names)
    if present.issuperset(DC_NAMES):  # a model of Gaussians
        dc = columns(DC_NAMES).astype(np.float64)
        return points, np.clip(0.5 + SH_C0 * dc, 0.0, 1.0)  # NaN stays; `read_points` refuses it
    return points, None


def _read_text(content: str) -> tuple[Array, NDArray[np.generic] | None]:
    """Read a table: lines of numbers between blanks, tabs, commas or semicolons.

    A line of names may come first, also behind ``//`` or ``#``. A line of one number is the count
    of points, with which each scan of a ``.pts`` file begins.
    """
    lines = [line for line in map(str.strip, content.splitlines()) if line]
    header = ""
    while lines and not _is_number(_split(lines[0])[0]):
        header = lines.pop(0)
    lines = [line for line in lines if not line.startswith(("#", "//")) and not line.isdecimal()]
    if not lines:
        return np.empty((0, 3)), None
    if DECIMAL_COMMAS.fullmatch(lines[0]):
        raise ValueError("it has decimal commas: write points")
    between = next((mark for mark in ",;" if mark in lines[0]), None)
    table = np.loadtxt(lines, delimiter=between, ndmin=2)
    positions, colors = _columns(table, _split(header.lstrip("/#% ")))
    return table[:, positions], table[:, colors] if colors else None


def _split(line: str) -> list[str]:
    return [word.strip(" \"'") for word in re.split(r"\s*[,;]\s*|\s+", line.strip(" \t,;"))]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _columns(table: Array, header: Sequence[str]) -> tuple[list[int], list[int]]:
    """The columns that are x, y, z and red, green, blue, by their names, else by `LAYOUTS`."""
    # CloudCompare writes "Rf", surveyors "X [m]"
    names = [re.sub(r"[\[(].*|[^a-z_]", "", word.lower()) for word in header]
    names = [word[0] if word in ("rf", "gf", "bf") else word for word in names]
    if len(names) == table.shape[1] and {"x", "y", "z"} <= set(names):
        named = next((group for group in COLOR_NAMES if set(group) <= set(names)), ())
        return [names.index(axis) for axis in "xyz"], [names.index(name) for name in named]
    if table.shape[1] not in LAYOUTS:
        raise ValueError(
            f"it has {table.shape[1]} columns without names: wanted are x y z, or x y z "
            "[intensity] red green blue, or a first line such as x,y,z,red,green,blue"
        )
    layouts = LAYOUTS[table.shape[1]]
    fitting = (list(layout) for layout in layouts if _is_plausible(table, list(layout)))
    return [0, 1, 2], next(fitting, list(layouts[0]))


def _is_plausible(table: Array, colors: list[int]) -> bool:
    """Return whether columns hold colours; without ``colors``, whether the others are normals."""
    if not colors:
        lengths = np.linalg.norm(table[:, 3:], axis=1)
        return table.shape[1] < 6 or bool((np.abs(lengths - 1) < UNIT).all())
    values = table[:, colors]
    is_whole = (values == np.round(values)).all() and values.max() > 1
    return bool((values >= 0).all() and (is_whole or values.max() <= 1))


def _eight_bits(colors: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Colours from 0 to 255: 16-bit values are divided by 257, floats in [0, 1] times 255."""
    values = colors.astype(np.float64)
    if colors.dtype.kind == "f" and values.max() <= 1.0:
        values = values * 255
    elif values.max() > 255:
        values = values / 257  # 65535 becomes 255
    return values.round().clip(0, 255).astype(np.uint8)
