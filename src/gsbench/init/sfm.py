"""Initialisers on COLMAP's SIFT features."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from pydantic import PositiveFloat, PositiveInt

from gsbench.errors import InputError
from gsbench.init.base import InitReport, Timer
from gsbench.init.colmap.pairs import STRONGEST, proposed_pairs
from gsbench.init.options import SiftOptions
from gsbench.init.reconstruction import Job, Matching, reconstruct
from gsbench.logs import Progress, no_progress
from gsbench.scene.types import Capture

if TYPE_CHECKING:
    from gsbench.init.colmap.database import DatabaseTask


@dataclass(frozen=True, kw_only=True)
class Sfm(SiftOptions):
    """SIFT, matching and incremental mapping by COLMAP.

    With the same seed and ``mapper_threads=1`` two runs give the same model bit for bit.
    """

    name: ClassVar[str] = "sfm"
    is_own_reference: ClassVar[bool] = True

    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        matching = Matching(match_by_sift)
        return reconstruct(self, matching, capture, output_dir, progress, reference, work_dir)


@dataclass(frozen=True, kw_only=True)
class SfmDense(Sfm):
    """`Sfm` with loose thresholds, for many more points: a substitute for deep image matching."""

    name: ClassVar[str] = "sfm_dense"
    is_own_reference: ClassVar[bool] = False

    max_num_features: PositiveInt = 16384  # per image
    # Together, these thresholds give 2.9 times the points on low-contrast ground, at a lower error.
    peak_threshold: PositiveFloat = 0.02 / 12
    edge_threshold: PositiveFloat = 20.0  # twice COLMAP's default


def match_by_sift(task: DatabaseTask, job: Job, progress: Progress, timer: Timer) -> dict[str, int]:
    """Write SIFT features and their verified matches into the database; returns counts."""
    from gsbench.init.colmap.database import colmap_masks, database_counts, strongest_descriptors
    from gsbench.init.colmap.matches import extract_sift, match_sift

    sift = job.options
    assert isinstance(sift, SiftOptions)
    with timer.phase("extract"):
        masks = colmap_masks(task.capture.masks, task.work_dir)
        extract_sift(
            task.database, task.images, task.names, sift, sift.num_threads, progress, masks
        )
    if database_counts(task.database)["features"] == 0:
        raise InputError(
            f"{sift.name}: no keypoint in any image: lower init.peak_threshold, or check the photos"
        )
    pairs, counts = task.pairs, {}
    if sift.pairs == "auto":
        with timer.phase("preview"):
            pairs = proposed_pairs(
                task.names, lambda name: strongest_descriptors(task.database, name, STRONGEST)
            )
        counts = {"pairs_selected": len(pairs), "pairs_left_out": len(task.pairs) - len(pairs)}
    with timer.phase("match"):
        match_sift(task.database, pairs, sift, sift.num_threads, progress)
    return counts
