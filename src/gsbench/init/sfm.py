"""Structure from motion on COLMAP's SIFT features."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from annotated_types import Ge, Interval
from pydantic import PositiveFloat, PositiveInt

from gsbench.errors import InputError
from gsbench.init.base import MODEL_FOLDER, InitReport, Timer
from gsbench.init.colmap.alignment import Array
from gsbench.init.colmap.initializer import MIN_DETECTION_SIZE, ColmapInitializer
from gsbench.logs import Progress, no_progress
from gsbench.scene.types import Capture
from gsbench.system.isolate import run_with_progress

if TYPE_CHECKING:
    from gsbench.init.colmap.database import DatabaseTask

# COLMAP's defaults
DEFAULT_PEAK_THRESHOLD = 0.02 / 3
DEFAULT_EDGE_THRESHOLD = 10.0
# Together they give 2.9 times the points on low-contrast ground, at a lower error.
DENSE_PEAK_THRESHOLD = 0.02 / 12
DENSE_EDGE_THRESHOLD = 20.0


@dataclass(frozen=True, kw_only=True)
class Sfm(ColmapInitializer):
    """SIFT, matching and incremental mapping by COLMAP.

    ``max_image_size`` is in px of the longest side. Larger images are shrunk for detection, and keypoints are scaled
    back to the files' size. With the same seed and ``mapper_threads=1`` two runs give the same model bit for bit.
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
        from gsbench.init.colmap.pairs import STRONGEST, proposed_pairs
        from gsbench.init.colmap.sift import extract_sift, match_sift

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
            match_sift(task.database, pairs, self, self.num_threads, progress)
        return counts


@dataclass(frozen=True, kw_only=True)
class SfmDense(Sfm):
    """`Sfm` with loose detection thresholds, for many more points: a substitute for deep image matching."""

    name: ClassVar[str] = "sfm_dense"
    is_own_reference: ClassVar[bool] = False

    max_num_features: PositiveInt = 16384
    peak_threshold: PositiveFloat = DENSE_PEAK_THRESHOLD
    edge_threshold: PositiveFloat = DENSE_EDGE_THRESHOLD


@dataclass(frozen=True, kw_only=True)
class Jittered(Sfm):
    """`Sfm` with ``copies`` randomly shifted copies of each point, in the point's colour.

    The shift is normal with standard deviation ``shift`` times the distance to the point's nearest neighbour. Copies
    have no tracks, so the report's errors and track lengths are those of the original points.
    """

    name: ClassVar[str] = "jittered"
    is_own_reference: ClassVar[bool] = False

    copies: PositiveInt = 1
    shift: PositiveFloat = 0.5

    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        """Run as `Sfm` does, with the copies in the model and counted in the report."""
        report = super().run(capture, output_dir, progress, reference, work_dir)
        return run_with_progress(_add_copies, (self, report, output_dir), progress, what=self.name)


def _add_copies(job: tuple[Jittered, InitReport, Path], progress: Progress) -> InitReport:
    import pycolmap

    from gsbench.init.report import write_result

    options, report, output_dir = job
    model = pycolmap.Reconstruction(output_dir / MODEL_FOLDER)
    points = [model.points3D[index] for index in sorted(model.points3D)]
    colors = np.array([point.color for point in points])  # [P, 3]
    copies = shifted_copies(np.array([point.xyz for point in points]), options.copies, options.shift, options.seed)
    for index, position in enumerate(copies):
        model.add_point3D(position, pycolmap.Track(), colors[index % len(colors)])
    counts = {**report.counts, "shifted_copies": len(copies)}
    result = replace(report, num_points=model.num_points3D(), counts=counts)
    write_result(model, result, output_dir)
    return result


def shifted_copies(points: Array, copies: int, shift: float, seed: int) -> Array:
    """Shifted copies [copies P, 3] of ``points`` [P, 3]; each repetition holds all points in their order."""
    from scipy.spatial import cKDTree  # takes a while to load

    distances, _ = cKDTree(points).query(points, k=2)  # [P, 2], the first neighbour is the point itself
    spread = shift * distances[:, 1:]  # [P, 1] world units
    noise = np.random.default_rng(seed).standard_normal((copies, len(points), 3))
    return (points + spread * noise).reshape(-1, 3)
