"""Reading clouds of points: PLY files of any program, and tables of numbers as text."""

import logging
import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.files import DAMAGE, require_regular
from gsbench.gaussians.ply_files import read_ply_data
from gsbench.init.point_tables import MAX_FRACTION, color_columns, plain_name, read_table
from gsbench.parsing import one_line, without_byte_order_mark
from gsbench.scene.types import Array

log = logging.getLogger(__name__)

DC_NAMES = ("f_dc_0", "f_dc_1", "f_dc_2")
SH_C0 = 0.5 / math.sqrt(math.pi)  # the constant spherical harmonic, by which 3DGS multiplies f_dc
TEXT_SUFFIXES = (".xyz", ".txt", ".csv", ".pts", ".asc")


def read_points(path: Path) -> tuple[Array, NDArray[np.uint8] | None]:
    """Read points [P, 3] float64 and colours [P, 3], or None for a file without colours.

    The suffix tells the format. A ``.ply`` file, text or binary, has vertices with x, y, z in any
    order and type, and colours as whole numbers or in [0, 1]. A text file has the columns that its
    first line names, else those of `point_tables.LAYOUTS`. Raises ``InputError`` for a file that
    cannot be read, holds no point, or has a coordinate or colour that is not a finite number.
    """
    suffix = path.suffix.lower()
    require_regular(path)
    try:
        if suffix == ".ply":
            points, colors = _read_ply(path)
        elif suffix in TEXT_SUFFIXES:
            content = without_byte_order_mark(path.read_bytes())
            points, colors = read_table(content.decode(errors="replace"), path)
        else:
            raise ValueError(
                f"known are .ply, {', '.join(TEXT_SUFFIXES)}: convert it to PLY, for example with "
                "CloudCompare"
            )
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


def _read_ply(path: Path) -> tuple[Array, NDArray[np.generic] | None]:
    content = read_ply_data(path)
    if "vertex" not in content:
        elements = ", ".join(element.name for element in content)
        raise ValueError(f"it has no element vertex, only {elements or 'a header'}")
    vertices = content["vertex"].data
    written = vertices.dtype.names or ()
    names = {plain_name(name): name for name in written} | {name.lower(): name for name in written}
    if lacking := [name for name in "xyz" if name not in names]:
        raise ValueError(f"its vertices have no property {', '.join(lacking)}")

    def columns(wanted: Iterable[str]) -> NDArray[np.generic]:
        return np.stack([vertices[names[name]] for name in wanted], axis=1)

    points = columns("xyz").astype(np.float64)
    if set(DC_NAMES) <= set(written):  # a model of Gaussians
        dc = np.stack([vertices[name] for name in DC_NAMES], axis=1).astype(np.float64)
        return points, np.clip(0.5 + SH_C0 * dc, 0.0, 1.0)  # NaN stays; `read_points` refuses it
    colored = color_columns(names, path)
    return points, columns(colored) if colored else None


def _eight_bits(colors: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Colours from 0 to 255: 16-bit values are divided by 257, fractions multiplied by 255."""
    values = colors.astype(np.float64)
    is_whole = values.max() > 1 and (values == values.round()).all()
    if colors.dtype.kind == "f" and values.max() <= MAX_FRACTION and not is_whole:
        values = values * 255
    elif values.max() > 255:
        values = values / 257  # 65535 becomes 255
    return values.round().clip(0, 255).astype(np.uint8)
