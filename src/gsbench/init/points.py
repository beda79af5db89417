"""Initialisers that start from a file: points of any origin (laser scans, multi-view stereo), or a trained model."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData
from pydantic import PositiveInt

from gsbench.errors import InputError
from gsbench.files import file_sha256, require_regular
from gsbench.init.base import GAUSSIANS_FILE, InitReport, PointCloud, Seed
from gsbench.init.colmap.alignment import Array
from gsbench.init.placed import PlacedCloud, points_in_view
from gsbench.logs import Progress, no_progress
from gsbench.parsing import one_line
from gsbench.scene.types import Capture
from gsbench.settings import AnyPath

if TYPE_CHECKING:
    import pycolmap

COLOR_NAMES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
TEXT_SUFFIXES = (".xyz", ".txt", ".csv", ".pts")


def read_points(path: Path) -> tuple[Array, NDArray[np.uint8] | None]:
    """Points [P, 3] float64 and their colours [P, 3], None if the file has no colours; the suffix tells the format.

    A ``.ply`` file, text or binary, has vertices with x, y, z in any order and type, and colours as whole numbers or in
    [0, 1]. A text file has the columns x, y, z, optionally followed by red, green, blue. Raises ``InputError`` for a
    file that cannot be read, holds no point, or has a coordinate or colour that is not a finite number.
    """
    suffix = path.suffix.lower()
    require_regular(path)
    try:
        if suffix == ".ply":
            points, colors = _read_ply(path)
        elif suffix in TEXT_SUFFIXES:
            points, colors = _columns(np.loadtxt(path, delimiter="," if suffix == ".csv" else None, ndmin=2))
        else:
            raise ValueError(f"known are .ply, {', '.join(TEXT_SUFFIXES)}")
    except Exception as error:  # readers may raise any exception on a damaged file, numpy even tokenizer errors
        raise InputError(f"{path}: not a readable file of points ({one_line(str(error))})") from error
    if len(points) == 0:
        raise InputError(f"{path}: holds no point")
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise InputError(
            f"{path}: {bad.sum():,} of {len(points):,} points have coordinates that are not finite numbers"
        )
    if colors is None:
        return points, None
    if not np.isfinite(colors.astype(np.float64)).all() or colors.min() < 0:
        raise InputError(f"{path}: has colours that are negative or not finite numbers")
    return points, _eight_bits(colors)


def _read_ply(path: Path) -> tuple[Array, NDArray[np.generic] | None]:
    vertices = PlyData.read(str(path))["vertex"].data
    present = vertices.dtype.names or ()
    lacking = [name for name in "xyz" if name not in present]
    if lacking:
        raise ValueError(f"its vertices have no property {', '.join(lacking)}")
    points = np.stack([vertices[name].astype(np.float64) for name in "xyz"], axis=1)
    for names in COLOR_NAMES:
        if all(name in present for name in names):
            return points, np.stack([vertices[name] for name in names], axis=1)
    return points, None


def _columns(table: NDArray[np.generic]) -> tuple[Array, NDArray[np.generic] | None]:
    if table.ndim != 2 or table.shape[1] not in (3, 6) or table.dtype.kind not in "fiu":
        raise ValueError(f"must be a table of 3 or 6 columns of numbers, is {table.shape} {table.dtype}")
    return table[:, :3].astype(np.float64), table[:, 3:] if table.shape[1] == 6 else None


def _eight_bits(colors: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Colours from 0 to 255: 16-bit values are divided by 257, floats in [0, 1] multiplied by 255."""
    values = colors.astype(np.float64)
    if colors.dtype.kind == "f" and values.max() <= 1.0:
        values = values * 255
    elif values.max() > 255:
        values = values / 257  # 65535 becomes 255
    return values.round().clip(0, 255).astype(np.uint8)


GREY = 128  # for points without a colour in the file that no training photograph shows


@dataclass(frozen=True, kw_only=True)
class CloudFromFile(PlacedCloud):
    """Base of initialisers that read their points from the file ``path``."""

    path: AnyPath

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.file.is_file():
            raise InputError(f"init.path={self.path} is not a file")

    @property
    def file(self) -> Path:
        return Path(self.path).expanduser()

    def content(self) -> str:
        """The sha256 of the file."""
        return file_sha256(self.file)


@dataclass(frozen=True, kw_only=True)
class Points(CloudFromFile):
    """The points of a file, which must have the coordinates of the reference cameras.

    At most ``max_points`` random points are kept. If the file has no colours, a point's colour comes from the
    photograph of the nearest training camera that has it in view.
    """

    name: ClassVar[str] = "points"

    max_points: PositiveInt | None = 200_000
    seed: Seed = 0

    def cloud(self, capture: Capture, model: pycolmap.Reconstruction) -> PointCloud:
        points, colors = read_points(self.file)
        chosen = np.sort(np.random.default_rng(self.seed).permutation(len(points))[: self.max_points])
        points, colors = points[chosen], None if colors is None else colors[chosen]
        seen = seen_colors(points, capture, model)
        if (seen < 0).all():
            raise InputError(
                f"init.path={self.path}: no point is in view of a training camera of scene {capture.name}: the cloud "
                "lies in other coordinates; bring it into those of the cameras"
            )
        if colors is None:
            colors = np.where(seen < 0, GREY, seen).astype(np.uint8)
        return PointCloud(points, colors)


def seen_colors(points: Array, capture: Capture, model: pycolmap.Reconstruction) -> NDArray[np.int16]:
    """Colours [P, 3] of ``points`` in the photograph of the nearest training camera that has them in view, else -1.

    Occlusion is ignored; the nearest camera is the least likely to be occluded. Pixels that a mask ignores give no
    colour.
    """
    from gsbench.scene.images import read_image, read_mask

    colors = np.full((len(points), 3), -1, dtype=np.int16)
    nearest = np.full(len(points), np.inf)
    for name in capture.train_names:
        seen, pixels, distance = points_in_view(points, name, model)
        if name in capture.masks and len(seen):
            column, row = pixels.astype(np.int64).T
            counted = read_mask(capture.masks[name])[row, column]  # [V]
            seen, pixels, distance = seen[counted], pixels[counted], distance[counted]
        nearer = distance < nearest[seen]
        kept, (column, row) = seen[nearer], pixels[nearer].astype(np.int64).T
        if len(kept):
            colors[kept] = read_image(capture.images / name)[row, column]
        nearest[kept] = distance[nearer]
    return colors


@dataclass(frozen=True, kw_only=True)
class Ply(CloudFromFile):
    """The Gaussians of a 3DGS PLY file, which must have the coordinates of the reference cameras.

    The model holds their means and colours as points. Training starts from the Gaussians in `GAUSSIANS_FILE`.
    """

    name: ClassVar[str] = "ply"

    def __post_init__(self) -> None:
        super().__post_init__()
        from gsbench.gaussians.ply import check_ply

        check_ply(self.file)

    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        """Run as `PlacedCloud.run` does, and write the Gaussians to `GAUSSIANS_FILE`."""
        result = super().run(capture, output_dir, progress, reference, work_dir)
        shutil.copyfile(self.file, output_dir / GAUSSIANS_FILE)
        return result

    def cloud(self, capture: Capture, model: pycolmap.Reconstruction) -> PointCloud:
        from gsbench.gaussians.model import dc_to_rgb
        from gsbench.gaussians.ply import read_ply

        gaussians = read_ply(self.file)
        colors = (dc_to_rgb(gaussians.sh_dc).clamp(0, 1) * 255).round().byte().numpy()  # [N, 3]
        return PointCloud(gaussians.means.double().numpy(), colors)
