"""Initialisers on COLMAP's SIFT features."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import PositiveFloat, PositiveInt

from gsbench.errors import InputError
from gsbench.init.base import InitReport, Timer
from gsbench.init.colmap.pairs import STRONGEST, proposed_pairs
from gsbench.init.colmap_initializer import ColmapInitializer
from gsbench.init.options import SiftOptions
from gsbench.logs import Progress
from gsbench.scene.types import Array

if TYPE_CHECKING:
    import pycolmap

    from gsbench.init.colmap.database import DatabaseTask


@dataclass(frozen=True, kw_only=True)
class Sfm(SiftOptions, ColmapInitializer):
    """SIFT, matching and incremental mapping by COLMAP.

    With the same seed and ``mapper_threads=1`` two runs give the same model bit for bit.
    """

    name: ClassVar[str] = "sfm"
    is_own_reference: ClassVar[bool] = True

    def fill_database(self, task: DatabaseTask, progress: Progress, timer: Timer) -> dict[str, int]:
        from gsbench.init.colmap.database import (
            colmap_masks,
            database_counts,
            strongest_descriptors,
        )
        from gsbench.init.colmap.features import extract_sift
        from gsbench.init.colmap.matches import match_sift

        with timer.phase("extract"):
            masks = colmap_masks(task.capture.masks, task.work_dir)
            extract_sift(
                task.database, task.images, task.names, self, self.num_threads, progress, masks
            )
        if database_counts(task.database)["features"] == 0:
            raise InputError(
                f"{self.name}: no keypoint in any image: lower init.peak_threshold, or check the "
                "photos"
            )
        pairs, counts = task.pairs, {}
        if self.pairs == "auto":
            with timer.phase("preview"):
                pairs = proposed_pairs(
                    task.names, lambda name: strongest_descriptors(task.database, name, STRONGEST)
                )
            counts = {"pairs_selected": len(pairs), "pairs_left_out": len(task.pairs) - len(pairs)}
        with timer.phase("match"):
            match_sift(task.database, pairs, self, self.num_threads, progress)
        return counts


@dataclass(frozen=True, kw_only=True)
class SfmDense(Sfm):
    """`Sfm` with loose thresholds, for many more points: a substitute for deep image matching."""

    name: ClassVar[str] = "sfm_dense"
    is_own_reference: ClassVar[bool] = False

    max_num_features: PositiveInt = 16384
    # Together, these thresholds give 2.9 times the points on low-contrast ground, at a lower error.
    peak_threshold: PositiveFloat = 0.02 / 12
    edge_threshold: PositiveFloat = 20.0


@dataclass(frozen=True, kw_only=True)
class Jittered(Sfm):
    """`Sfm` with ``copies`` randomly shifted copies of each point, in the point's colour.

    The shift is normal with standard deviation ``shift`` times the distance to the point's nearest
    neighbour. Copies have no tracks, so the report's errors and track lengths are those of the
    original points.
    """

    name: ClassVar[str] = "jittered"
    is_own_reference: ClassVar[bool] = False

    copies: PositiveInt = 1
    shift: PositiveFloat = 0.5

    def extend(self, model: pycolmap.Reconstruction, report: InitReport) -> InitReport:
        import pycolmap

        from gsbench.scene.colmap import model_points

        points, colors = model_points(model)
        copies = shifted_copies(points, self.copies, self.shift, self.seed)
        for position, color in zip(copies, np.tile(colors, (self.copies, 1)), strict=True):
            model.add_point3D(position, pycolmap.Track(), color)
        counts = {**report.counts, "shifted_copies": len(copies)}
        return replace(report, num_points=model.num_points3D(), counts=counts)


def shifted_copies(points: Array, copies: int, shift: float, seed: int) -> Array:
    """Shifted copies [copies P, 3] of ``points`` [P, 3]: all points in order, ``copies`` times."""
    from scipy.spatial import cKDTree  # takes a while to load

    distances, _ = cKDTree(points).query(
        points, k=2
    )  # [P, 2], the first neighbour is the point itself
    spread = shift * distances[:, 1:]  # [P, 1] world units
    noise = np.random.default_rng(seed).standard_normal((copies, len(points), 3))
    return (points + spread * noise).reshape(-1, 3)
