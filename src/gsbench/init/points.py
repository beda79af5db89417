"""Point clouds of any origin (laser scans, multi-view stereo, depth networks) as the start of a training."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import PositiveFloat, PositiveInt

from gsbench.errors import InputError
from gsbench.files import file_sha256
from gsbench.init.base import PointCloud, Seed
from gsbench.init.colmap.alignment import Array
from gsbench.init.placed import PlacedCloud, in_view
from gsbench.init.point_files import read_points, read_similarity
from gsbench.scene.types import Capture
from gsbench.settings import AnyPath

if TYPE_CHECKING:
    import pycolmap

GREY = 128  # of points that no training photograph shows, where the file has no colours


@dataclass(frozen=True, kw_only=True)
class Points(PlacedCloud):
    """The points of a file under the reference cameras: in their gauge, or moved there by a given similarity.

    ``voxel`` keeps the mean of the points in each cube of that edge (units of the cameras), ``max_points`` then so many
    at random. Colours that the file lacks come from the nearest training camera's photograph that a point falls into.
    """

    name: ClassVar[str] = "points"

    path: AnyPath
    transform: AnyPath | None = None
    voxel: PositiveFloat | None = None
    max_points: PositiveInt | None = 200_000
    seed: Seed = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        for key, path in (("path", self.path), ("transform", self.transform)):
            if path is not None and not Path(path).expanduser().is_file():
                raise InputError(f"init.{key}={path} is no file")

    def content(self) -> str:
        """sha256 over the files: what the result depends on beside the options."""
        files = [path for path in (self.path, self.transform) if path is not None]
        return hashlib.sha256("".join(file_sha256(Path(path).expanduser()) for path in files).encode()).hexdigest()

    def cloud(self, capture: Capture, model: pycolmap.Reconstruction) -> PointCloud:
        points, colors = read_points(Path(self.path).expanduser())
        if self.transform is not None:
            points = read_similarity(Path(self.transform).expanduser())(points)
        if self.voxel is not None:
            points, colors = one_in_each_voxel(points, colors, self.voxel)
        if self.max_points is not None and len(points) > self.max_points:
            chosen = np.sort(np.random.default_rng(self.seed).permutation(len(points))[: self.max_points])
            points, colors = points[chosen], None if colors is None else colors[chosen]
        seen = seen_colors(points, capture, model)
        if (seen < 0).all():
            raise InputError(
                f"init.path={self.path}: no point is in view of a training camera of scene {capture.name}: the cloud "
                "lies in other coordinates; give init.transform, the similarity to those of the cameras"
            )
        if colors is None:
            colors = np.where(seen < 0, GREY, seen).astype(np.uint8)
        return PointCloud(points, colors)


def one_in_each_voxel(
    points: Array, colors: NDArray[np.uint8] | None, edge: float
) -> tuple[Array, NDArray[np.uint8] | None]:
    """The mean of the points [P, 3], and of their colours, in each cube of a grid; in order of their first point."""
    _, first, cubes = np.unique(np.floor(points / edge), axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    cubes = rank[cubes.reshape(-1)]  # [P]
    counts = np.bincount(cubes)[:, None]

    def mean(values: Array) -> Array:
        return np.stack([np.bincount(cubes, column) for column in values.T], axis=1) / counts

    return mean(points), None if colors is None else mean(colors.astype(np.float64)).round().astype(np.uint8)


def seen_colors(points: Array, capture: Capture, model: pycolmap.Reconstruction) -> NDArray[np.int16]:
    """Colours [P, 3] of ``points`` in the photograph of the nearest training camera that they fall into; -1 in none.

    What stands between is not looked for: the nearest camera is the least likely to have something there. Pixels that
    a mask ignores give no colour.
    """
    from gsbench.scene.images import read_image
    from gsbench.scene.masks import read_mask

    colors = np.full((len(points), 3), -1, dtype=np.int16)
    nearest = np.full(len(points), np.inf)
    for name in capture.train_names:
        seen, pixels, distance = in_view(points, name, model)
        if name in capture.masks and len(seen):
            column, row = pixels.astype(np.int64).T
            counts = read_mask(capture.masks[name])[row, column]  # [V]
            seen, pixels, distance = seen[counts], pixels[counts], distance[counts]
        nearer = distance < nearest[seen]
        kept, (column, row) = seen[nearer], pixels[nearer].astype(np.int64).T
        if len(kept):
            colors[kept] = read_image(capture.images / name)[row, column]
        nearest[kept] = distance[nearer]
    return colors
