"""Reading clouds of points: PLY files of any program."""

import logging
import math
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.files import DAMAGE, require_regular
from gsbench.gaussians.ply_files import read_ply_data, recognised_format
from gsbench.parsing import one_line
from gsbench.scene.types import Array, ByteArray

log = logging.getLogger(__name__)

DC_NAMES = ("f_dc_0", "f_dc_1", "f_dc_2")
SH_C0 = 0.5 / math.sqrt(math.pi)  # the constant spherical harmonic, by which 3DGS multiplies f_dc
COLOR_NAMES = (("red", "green", "blue"), ("r", "g", "b"))
WITHOUT_COLOR = frozenset(("x", "y", "z", "nx", "ny", "nz"))
# Before the name of a column: CloudCompare writes colours that it computed as scalar_R.
PREFIX = re.compile(r"^(colou?r|rgb|diffuse|ambient|scalar)_")
# Colours up to this are fractions, even if tone mapping or rounding went beyond 1. As bytes they
# would all be black.
MAX_FRACTION = 2.0
REMEDY = "convert it to PLY with the properties x, y, z [red, green, blue], such as by CloudCompare"


def read_points(path: Path) -> tuple[Array, ByteArray | None]:
    """Read points [P, 3] float64 and colours [P, 3], or None for a file without colours.

    The file is a PLY, text or binary, whose vertices have x, y, z in any order and type, and
    colours as whole numbers or in [0, 1]. Raises ``InputError`` for a file that cannot be read,
    holds no point, or has a coordinate or colour that is not a finite number.
    """
    require_regular(path)
    try:
        if path.suffix.lower() != ".ply":
            raise ValueError(_other_format(path))
        _, vertices = read_ply_data(path)
        points, colors = _points_and_colors(vertices, path)
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
    kind = recognised_format(path)
    return f"it is {kind}" if kind else f"it is no PLY: {REMEDY}"


def _points_and_colors(
    vertices: NDArray[np.void], path: Path
) -> tuple[Array, NDArray[np.generic] | None]:
    """Points [P, 3] and colours [P, 3], or None, from properties with any of the known names.

    One log line names the columns that are not used if there is no colour.
    """

    def stacked(names: Iterable[str]) -> NDArray[np.generic]:
        return np.stack([known[name] for name in names], axis=1)

    names = vertices.dtype.names or ()
    known = {PREFIX.sub("", name.lower()): vertices[name] for name in names}
    known |= {name.lower(): vertices[name] for name in names}
    if lacking := [name for name in "xyz" if name not in known]:
        raise ValueError(f"it has no column {', '.join(lacking)}: {REMEDY}")
    points = stacked("xyz").astype(np.float64)
    if known.keys() >= {*DC_NAMES}:  # a model of Gaussians
        dc = stacked(DC_NAMES).astype(np.float64)
        return points, np.clip(0.5 + SH_C0 * dc, 0.0, 1.0)  # NaN stays; `read_points` refuses it
    for group in COLOR_NAMES:
        if known.keys() >= {*group}:
            return points, stacked(group)
    if others := [name for name in names if name.lower() not in WITHOUT_COLOR]:
        log.warning(
            "%s: it has no red, green and blue, and its %s is not used", path, ", ".join(others)
        )
    return points, None


def _eight_bits(colors: NDArray[np.generic]) -> ByteArray:
    """Colours from 0 to 255: 16-bit values are divided by 257, fractions multiplied by 255."""
    values = colors.astype(np.float64)
    is_whole = values.max() > 1 and (values == values.round()).all()
    if colors.dtype.kind == "f" and values.max() <= MAX_FRACTION and not is_whole:
        values = values * 255
    elif values.max() > 255:
        values = values / 257  # 65535 becomes 255
    return values.round().clip(0, 255).astype(np.uint8)
