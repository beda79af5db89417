"""Reading clouds of points from tables of numbers, as scanners and other programs write them."""

import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gsbench.scene.types import Array

log = logging.getLogger(__name__)

COLOR_NAMES = (("red", "green", "blue"), ("r", "g", "b"))
WITHOUT_COLOR = frozenset(("x", "y", "z", "nx", "ny", "nz"))
# Before the name of a column: CloudCompare writes colours that it computed as scalar_R.
PREFIX = re.compile(
    r"^(pos(ition)?|coord(inate)?|point|vertex|colou?r|rgb|diffuse|ambient|scalar)(?=[\W_])"
)
# Surveyors' names of the axes, from the first to the third.
AXES = (("x", "easting", "east"), ("y", "northing", "north"), ("z", "height", "elevation", "up"))
ANGLES = re.compile("lat(itude)?|lon(gitude)?|lng")
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
DECIMAL_COMMAS = re.compile(r"-?\d+,\d+([\s;]+-?\d+(,\d+)?)+")
PACKED_COLOR = re.compile(r"(#|\b0x)[0-9a-fA-F]{6}\b")
UNIT = 0.01  # the length of a normal written with few digits differs from 1 by less
MAX_BYTE = 255
# Colours up to this are fractions, even if tone mapping or rounding went beyond 1. As bytes they
# would all be black.
MAX_FRACTION = 2.0
WANTED = "x y z, or x y z [intensity] red green blue, or a first line such as x,y,z,red,green,blue"


def read_table(content: str, path: Path) -> tuple[Array, Array | None]:
    """Read points [P, 3] and colours [P, 3], or None, from lines of numbers.

    Numbers stand between blanks, tabs, commas or semicolons. A line of names may come first, also
    behind ``//`` or ``#``. A line of one number is the count of points, with which each scan of a
    ``.pts`` file begins. Raises ValueError for other tables.
    """
    lines = [line for line in map(str.strip, content.splitlines()) if line]
    header = ""
    while lines and not _is_number(_split(lines[0])[0]):
        header = lines.pop(0)
        if "POINT3D_ID" in header:
            raise ValueError("it belongs to a COLMAP model: init=dataset reads its folder")
    lines = [line for line in lines if not line.startswith(("#", "//")) and not line.isdecimal()]
    if not lines:
        if header:
            raise ValueError(f"no line is a row of numbers: wanted are {WANTED}")
        return np.empty((0, 3)), None
    if DECIMAL_COMMAS.fullmatch(lines[0]):
        raise ValueError("it has decimal commas: write points")
    if PACKED_COLOR.search(lines[0]):
        raise ValueError("it has colours such as #ff8000: write red, green and blue as numbers")
    between = next((mark for mark in ",;" if mark in lines[0]), None)
    # Spreadsheets put numbers in quotes, and a mark after the last.
    plain = (line.rstrip(f" \t{between}") for line in lines) if between else lines
    try:
        table = np.loadtxt(plain, delimiter=between, quotechar='"', ndmin=2)  # [P, columns]
    except ValueError as error:
        raise ValueError(_odd_line(lines)) from error
    if not header and _counts_points(table):
        log.warning("%s: its first column counts the points and is not used", path)
        table = table[:, 1:]
    positions, colors = _columns(table, header, path)
    return table[:, positions], table[:, colors] if colors else None


def _split(line: str) -> list[str]:
    """The words of a line; with commas or semicolons, blanks are part of a word."""
    line = line.strip(" \t,;")
    between = r"[,;]" if "," in line or ";" in line else r"\s+"
    return [word.strip(" \"'\t") for word in re.split(between, line)]


def _odd_line(lines: Sequence[str]) -> str:
    """Say which line is the first that is no row of as many numbers as the first line."""
    count = len(_split(lines[0]))
    for line in lines:
        words = _split(line)
        if len(words) != count or not all(map(_is_number, words)):
            return f"the line {line[:60]!r} is no row of {count} numbers: wanted are {WANTED}"
    return f"not all lines are rows of {count} numbers: wanted are {WANTED}"


def _counts_points(table: Array) -> bool:
    """Return whether a table without names begins with a column that numbers its rows."""
    count, columns = table.shape
    first = table[:, 0]
    counts = first[0] in (0, 1) and (first == first[0] + np.arange(count)).all()
    return columns > 3 and count > 2 and bool(counts)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def plain_name(word: str) -> str:
    """The name of a column without its unit: ``x`` for ``X [m]``, ``r`` for ``Color R``."""
    name = PREFIX.sub("", re.sub(r"[\[(].*", "", word.lower()).strip())
    name = re.sub(r"[^a-z_]", "", name).strip("_")
    return name[0] if name in ("rf", "gf", "bf") else name  # as CloudCompare writes


def color_columns(names: Mapping[str, str], path: Path) -> tuple[str, ...]:
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


def _columns(table: Array, header: str, path: Path) -> tuple[list[int], list[int]]:
    """The columns that are x, y, z and red, green, blue, by their names, else by `LAYOUTS`."""
    words = _split(header.lstrip("/#% "))
    names = [plain_name(word) for word in words]
    count = table.shape[1]
    if len(names) == count:
        axes = [next((names.index(name) for name in axis if name in names), -1) for axis in AXES]
        if -1 not in axes:
            others = {names[k]: words[k] for k in range(count) if k not in axes}
            return axes, [names.index(name) for name in color_columns(others, path)]
        if any(ANGLES.fullmatch(name) for name in names):
            raise ValueError("it has degrees of latitude and longitude: convert them to lengths")
    if count not in LAYOUTS:
        raise ValueError(f"it has {count} columns without names: wanted are {WANTED}")
    fitting = [list(layout) for layout in LAYOUTS[count] if _is_plausible(table, list(layout))]
    if len(fitting) > 1 and path.suffix.lower() != ".pts":
        fitting.sort(key=lambda layout: _is_doubtful(table, layout))
    colors = fitting[0] if fitting else list(LAYOUTS[count][0])
    if count > 6 or (header and len(names) == count):
        shown = ["x", "y", "z", *("?" * (count - 3))]
        for column, name in zip(colors, ("red", "green", "blue"), strict=bool(colors)):
            shown[column] = name
        log.warning(
            "%s: its columns are read as %s; a first line of names decides otherwise",
            path,
            " ".join(shown),
        )
    return [0, 1, 2], colors


def _is_plausible(table: Array, colors: list[int]) -> bool:
    """Return whether columns hold colours; without ``colors``, whether the others are normals."""
    if not colors:
        lengths = np.linalg.norm(table[:, 3:], axis=1)
        return table.shape[1] < 6 or bool((np.abs(lengths - 1) < UNIT).all())
    values = table[:, colors]
    is_whole = (values == np.round(values)).all() and values.max() > 1
    return bool((values >= 0).all() and (is_whole or values.max() <= MAX_FRACTION))


def _is_doubtful(table: Array, colors: list[int]) -> bool:
    """Return whether a colour is rather opacity, equal in all rows, or beyond a byte."""
    values = table[:, colors]
    is_constant = (values == values[:1]).all(axis=0)  # [3], or [0] without colours
    return bool(is_constant.any() or values.max(initial=0) > MAX_BYTE)
