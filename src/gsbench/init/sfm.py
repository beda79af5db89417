"""Structure from motion on COLMAP's SIFT features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from gsbench.errors import InputError
from gsbench.init.base import Progress
from gsbench.init.checks import check_integer, check_number
from gsbench.init.colmap_initializer import ColmapInitializer, DatabaseTask
from gsbench.init.timer import Timer

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

    max_image_size: int = 1600
    max_num_features: int = 8192
    peak_threshold: float = DEFAULT_PEAK_THRESHOLD
    edge_threshold: float = DEFAULT_EDGE_THRESHOLD
    first_octave: int = -1
    max_ratio: float = 0.8
    cross_check: bool = True
    guided_matching: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_integer("max_image_size", self.max_image_size, 32)
        check_integer("max_num_features", self.max_num_features, 1)
        check_number("peak_threshold", self.peak_threshold, 0, exclusive=True)
        check_number("edge_threshold", self.edge_threshold, 0, exclusive=True)
        check_integer("first_octave", self.first_octave, -1, 5)
        check_number("max_ratio", self.max_ratio, 0, 1, exclusive=True)

    def fill_database(self, task: DatabaseTask, progress: Progress, timer: Timer) -> None:
        from gsbench.init.colmap_database import database_counts
        from gsbench.init.reconstruct import verification_options
        from gsbench.init.sift import extract_sift, match_sift

        with timer.phase("extract"):
            extract_sift(task.database, task.images, task.names, self, self.num_threads, progress)
        if database_counts(task.database)["features"] == 0:
            raise InputError(f"{self.name}: no keypoint in any image: lower init.peak_threshold, or check the photos")
        with timer.phase("match"):
            verification = verification_options(self.seed, self.min_inliers)
            match_sift(task.database, task.pairs, self, verification, self.num_threads, progress)


@dataclass(frozen=True, kw_only=True)
class SfmDense(Sfm):
    """`Sfm` with loose detection thresholds, for many more points: an offline stand-in beside deep image matching."""

    name: ClassVar[str] = "sfm_dense"
    is_own_reference: ClassVar[bool] = False

    max_num_features: int = 16384
    peak_threshold: float = DENSE_PEAK_THRESHOLD
    edge_threshold: float = DENSE_EDGE_THRESHOLD
