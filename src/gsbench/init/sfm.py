"""Structure from motion by COLMAP: the base of initialisers that end in COLMAP, and those on
COLMAP's SIFT features."""

from __future__ import annotations

import logging
import shutil
from abc import abstractmethod
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Interval
from pydantic import PositiveFloat, PositiveInt

from gsbench.errors import InputError
from gsbench.init.base import (
    WORK_FOLDER,
    Initializer,
    InitReport,
    PointsFrom,
    Poses,
    Preparation,
    Seed,
    Timer,
)
from gsbench.init.colmap.pairs import STRONGEST, Pairing, proposed_pairs
from gsbench.logs import Progress, no_progress
from gsbench.scene.options import MIN_IMAGES
from gsbench.scene.types import Array, Capture
from gsbench.settings import Fraction, Threads, check_settings
from gsbench.system.isolate import run_with_progress
from gsbench.system.resources import available_cores
from gsbench.words import counted

if TYPE_CHECKING:
    import pycolmap

    from gsbench.init.colmap.database import DatabaseTask

logger = logging.getLogger(__name__)

LOG_FILE = "colmap.log"
CameraSharing = Literal["single", "per_folder", "per_image"]
CameraModel = Literal[
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"
]
Intrinsics = Literal["estimate", "reference"]
MIN_DETECTION_SIZE = 32  # px: detectors find nothing in smaller images


@dataclass(frozen=True, kw_only=True)
class ColmapInitializer(Initializer):
    """Base of `Sfm`, `SfmDense`, `Dim` and `SiftKornia`, with the settings that they share.

    With ``poses=shared``, points are triangulated under the reference cameras. With ``poses=own``,
    cameras and points are estimated; if there is a reference and ``align`` is set, a similarity
    then moves them into its gauge.

    With ``points_from=train``, test views contribute no points. Under given cameras their
    photographs are not read. If cameras are estimated, all photographs are used for the cameras,
    and only points of training views are kept.

    The reference is the ``reference`` given to `run`, else the model that came with the capture.
    """

    # estimates the poses itself if poses=shared and there is no reference
    is_own_reference: ClassVar[bool] = False

    poses: Poses = "shared"
    align: bool = True
    camera: CameraSharing = "single"
    camera_model: CameraModel = "SIMPLE_RADIAL"
    focal_length: PositiveFloat | None = None
    intrinsics: Intrinsics = "estimate"
    pairs: Pairing = "exhaustive"
    overlap: Annotated[int, Interval(ge=1, le=60)] = 10
    min_inliers: Annotated[int, Ge(7)] = 15  # a fundamental matrix needs seven
    min_inlier_ratio: Fraction = 0.0
    mapper: Literal["auto", "incremental", "global"] = "auto"
    min_model_size: Annotated[int, Ge(2)] = 3
    two_view_tracks: bool = False
    points_from: PointsFrom = "all"
    seed: Seed = 0
    threads: Threads | Literal["auto"] = "auto"
    mapper_threads: Threads = 1

    def __post_init__(self) -> None:
        check_settings(self, "init")

    @abstractmethod
    def fill_database(self, task: DatabaseTask, progress: Progress, timer: Timer) -> dict[str, int]:
        """Write features, matches and verified geometries, in the isolated process. Returns counts
        for the report."""

    @property
    def num_threads(self) -> int:
        """``threads`` as a number; ``auto`` is the number of cores that this process may use."""
        return available_cores() if self.threads == "auto" else self.threads

    def packages(self) -> tuple[str, ...]:
        """The packages whose versions are in the report."""
        return ("pycolmap", "numpy")

    @property
    def uses_reference_cameras(self) -> bool:
        """Return whether at least the intrinsics are taken from the reference, if there is one."""
        return self.poses == "shared" or self.intrinsics == "reference"

    def select_images(
        self, capture: Capture, reference: pycolmap.Reconstruction | None
    ) -> list[str]:
        """The sorted names of the images to use: all, or the images of the reference if its cameras
        are used."""
        if reference is None or not self.uses_reference_cameras:
            return sorted(capture.image_names)
        names = sorted(image.name for image in reference.images.values() if image.has_pose)
        ignored = set(capture.test_names) if self.ignores_test_photographs(reference) else set()
        return [name for name in names if name not in ignored]

    def ignores_test_photographs(self, reference: pycolmap.Reconstruction | None) -> bool:
        """Return whether test photographs are not read at all: given cameras do not need them."""
        return self.points_from != "all" and self.poses == "shared" and reference is not None

    def needs_reference(self, capture: Capture) -> bool:
        """Return whether `run` needs a ``reference`` because the capture came without cameras."""
        needs_poses = self.poses == "shared" and not self.is_own_reference
        return capture.model is None and (needs_poses or self.intrinsics == "reference")

    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        """Write model and report (see `Initializer.run`).

        ``work_dir`` keeps features and matches for a later run. Without it, they are kept in
        ``output_dir`` until the run succeeds, so that an interrupted run continues there.

        Raises ``InputError`` if no model can be made from the photographs with these settings.
        """
        self.check(capture, reference)
        output_dir.mkdir(parents=True, exist_ok=True)
        work = output_dir / WORK_FOLDER if work_dir is None else work_dir
        work.mkdir(parents=True, exist_ok=True)
        preparation = self.prepare(capture, work, reference, progress)
        from gsbench.init.colmap.mapping import ReconstructionJob, build_model

        job = ReconstructionJob(self, capture, output_dir, work, reference, preparation)
        report = run_with_progress(
            build_model, job, progress, what=self.name, log=output_dir / LOG_FILE
        )
        if work_dir is None:
            shutil.rmtree(work)
        for warning in report.warnings:
            logger.warning("%s: %s", self.name, warning)
        return report

    def check(self, capture: Capture, reference: Path | None) -> None:
        """Raise ``InputError``, before any work, if this capture cannot be initialised with these
        settings."""
        if len(capture.image_names) < MIN_IMAGES:
            raise InputError(
                f"scene {capture.name} has {counted(len(capture.image_names), 'image')}: "
                f"{self.name} needs at least "
                f"{MIN_IMAGES}"
            )
        if reference is None and self.needs_reference(capture):
            raise InputError(
                f"init={self.name} takes its cameras from a reference, and scene {capture.name} "
                "came without: "
                "make one with init=sfm first, or set init.poses=own and init.intrinsics=estimate"
            )

    def prepare(
        self, capture: Capture, work_dir: Path, reference: Path | None, progress: Progress
    ) -> Preparation:
        """Do the work that comes before COLMAP; none by default."""
        return Preparation()

    def extend(self, model: pycolmap.Reconstruction, report: InitReport) -> InitReport:
        """Change the model before it is written; returns its report. Runs in the isolated
        process."""
        return report


@dataclass(frozen=True, kw_only=True)
class Sfm(ColmapInitializer):
    """SIFT, matching and incremental mapping by COLMAP.

    ``max_image_size`` is in px of the longest side. Larger images are shrunk for detection, and
    keypoints are scaled back to the files' size. With the same seed and ``mapper_threads=1`` two
    runs give the same model bit for bit.
    """

    name: ClassVar[str] = "sfm"
    is_own_reference: ClassVar[bool] = True

    max_image_size: Annotated[int, Ge(MIN_DETECTION_SIZE)] = 1600
    max_num_features: PositiveInt = 8192
    peak_threshold: PositiveFloat = 0.02 / 3  # COLMAP's default, as is the next
    edge_threshold: PositiveFloat = 10.0
    first_octave: Annotated[int, Interval(ge=-1, le=5)] = -1
    max_ratio: Annotated[float, Interval(gt=0, le=1)] = 0.8
    cross_check: bool = True
    guided_matching: bool = False

    def fill_database(self, task: DatabaseTask, progress: Progress, timer: Timer) -> dict[str, int]:
        from gsbench.init.colmap.database import (
            colmap_masks,
            database_counts,
            strongest_descriptors,
        )
        from gsbench.init.colmap.sift import extract_sift, match_sift

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
    """`Sfm` with loose detection thresholds, for many more points: a substitute for deep image
    matching."""

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
    """Shifted copies [copies P, 3] of ``points`` [P, 3]; each repetition holds all points in their
    order."""
    from scipy.spatial import cKDTree  # takes a while to load

    distances, _ = cKDTree(points).query(
        points, k=2
    )  # [P, 2], the first neighbour is the point itself
    spread = shift * distances[:, 1:]  # [P, 1] world units
    noise = np.random.default_rng(seed).standard_normal((copies, len(points), 3))
    return (points + spread * noise).reshape(-1, 3)
