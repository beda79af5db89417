"""Structure from motion on COLMAP's SIFT features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from annotated_types import Ge, Interval
from pydantic import PositiveFloat, PositiveInt

from gsbench.errors import InputError
from gsbench.init.base import Timer
from gsbench.init.colmap.initializer import ColmapInitializer
from gsbench.init.colmap.options import MIN_DETECTION_SIZE, DatabaseTask
from gsbench.logs import Progress

DEFAULT_PEAK_THRESHOLD = 0.02 / 3  # COLMAP's defaults
DEFAULT_EDGE_THRESHOLD = 10.0
DENSE_PEAK_THRESHOLD = 0.02 / 12  # together: 2.9 times the points on low-contrast ground, at a lower error
DENSE_EDGE_THRESHOLD = 20.0


@dataclass(frozen=True, kw_only=True)
class Sfm(ColmapInitializer):
    """SIFT, matching and incremental mapping by COLMAP.

    Sizes are in px of the image files' longest side: larger images are shrunk for detection, and keypoints come back at
    the files' size. With one seed and ``mapper_threads=1`` two runs give the same model bit for bit.
    """

    name: ClassVar[str] = "sfm"
    is_own_reference: ClassVar[bool] = True

    max_image_size: Annotated[int, Ge(MIN_DETECTION_SIZE)] = 1600
    max_num_features: PositiveInt = 8192
    peak_threshold: PositiveFloat = DEFAULT_PEAK_THRESHOLD
    edge_threshold: PositiveFloat = DEFAULT_EDGE_THRESHOLD
    first_octave: Annotated[int, Interval(ge=-1, le=5)] = -1
    max_ratio: Annotated[float, Interval(gt=0, le=1)] = 0.8
    cross_check: bool = True
    guided_matching: bool = False

    def fill_database(self, task: DatabaseTask, progress: Progress, timer: Timer) -> dict[str, int]:
        from gsbench.init.colmap.database import colmap_masks, database_counts, strongest_descriptors
        from gsbench.init.colmap.reconstruct import Verification
        from gsbench.init.colmap.sift import extract_sift
        from gsbench.init.colmap.sift_matching import match_sift
        from gsbench.init.preview import STRONGEST, proposed_pairs

        with timer.phase("extract"):
            masks = colmap_masks(task.capture.masks, task.work_dir)
            extract_sift(task.database, task.images, task.names, self, self.num_threads, progress, masks)
        if database_counts(task.database)["features"] == 0:
            raise InputError(f"{self.name}: no keypoint in any image: lower init.peak_threshold, or check the photos")
        pairs, counts = task.pairs, {}
        if self.pairs == "auto":
            with timer.phase("preview"):
                pairs = proposed_pairs(task.names, lambda name: strongest_descriptors(task.database, name, STRONGEST))
            counts = {"pairs_selected": len(pairs), "pairs_left_out": len(task.pairs) - len(pairs)}
        with timer.phase("match"):
            verification = Verification(self.seed, self.min_inliers, self.min_inlier_ratio)
            match_sift(task.database, pairs, self, verification, self.num_threads, progress)
        return counts


@dataclass(frozen=True, kw_only=True)
class SfmDense(Sfm):
    """`Sfm` with loose detection thresholds, for many more points: an offline stand-in beside deep image matching."""

    name: ClassVar[str] = "sfm_dense"
    is_own_reference: ClassVar[bool] = False

    max_num_features: PositiveInt = 16384
    peak_threshold: PositiveFloat = DENSE_PEAK_THRESHOLD
    edge_threshold: PositiveFloat = DENSE_EDGE_THRESHOLD
