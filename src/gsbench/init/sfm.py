"""Initialisers on COLMAP's SIFT features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from pydantic import PositiveFloat, PositiveInt

from gsbench.errors import InputError
from gsbench.init.base import Timer
from gsbench.init.colmap.pairs import STRONGEST, proposed_pairs
from gsbench.init.options import SiftOptions
from gsbench.init.reconstruction import Facts, Job, Reconstruction
from gsbench.logs import Progress

if TYPE_CHECKING:
    from gsbench.init.colmap.database import DatabaseTask


@dataclass(frozen=True, kw_only=True)
class Sfm(Reconstruction, SiftOptions):
    """SIFT, matching and incremental mapping by COLMAP.

    With the same seed and ``mapper_threads=1`` two runs give the same model bit for bit.
    """

    name: ClassVar[str] = "sfm"
    is_own_reference: ClassVar[bool] = True

    def fill(self, job: Job, task: DatabaseTask, progress: Progress, timer: Timer) -> Facts:
        from gsbench.init.colmap.database import database_counts, linked, strongest_descriptors
        from gsbench.init.colmap.matches import extract_sift, match_sift

        masks = {f"{name}.png": file for name, file in job.capture.masks.items()}  # as COLMAP wants
        with timer.phase("extract"):
            folder = linked(masks, job.work_dir / "masks") if masks else None
            extract_sift(task, self, progress, folder)
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
            match_sift(task.database, pairs, self, progress)
        return {"counts": counts}


@dataclass(frozen=True, kw_only=True)
class SfmDense(Sfm):
    """`Sfm` with loose thresholds, for many more points: a substitute for deep image matching."""

    name: ClassVar[str] = "sfm_dense"
    is_own_reference: ClassVar[bool] = False

    max_num_features: PositiveInt = 16384  # per image
    # Together, these thresholds give 2.9 times the points on low-contrast ground, at a lower error.
    peak_threshold: PositiveFloat = 0.02 / 12
    edge_threshold: PositiveFloat = 20.0  # twice COLMAP's default
