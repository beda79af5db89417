"""What all initialisers that end in COLMAP share: their options, and the way from matches to a reported model."""

from __future__ import annotations

import logging
import shutil
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from gsbench.errors import InputError
from gsbench.init.base import (
    MODEL_FOLDER,
    OWN_GAUGE_FOLDER,
    POSES,
    REPORT_FILE,
    InitReport,
    Progress,
    no_progress,
)
from gsbench.init.checks import check_choice, check_integer, check_number
from gsbench.init.pairs import PAIRINGS
from gsbench.init.relay import run_with_progress
from gsbench.init.timer import Timer
from gsbench.scene.types import Capture

if TYPE_CHECKING:
    from gsbench.init.colmap_database import CameraGroup

logger = logging.getLogger(__name__)

CAMERA_SHARING = ("single", "per_folder", "per_image")
CAMERA_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
INTRINSICS = ("estimate", "reference")
MIN_IMAGES = 3  # two views have no third that could contradict a wrong geometry
LOG_FILE = "colmap.log"


@dataclass(frozen=True)
class Job:
    """One run of an initialiser, as it is handed to the isolated process."""

    initializer: ColmapInitializer
    capture: Capture
    output_dir: Path
    work_dir: Path
    reference: Path | None
    seconds: Mapping[str, float]  # of what was done before


@dataclass(frozen=True, kw_only=True)
class ColmapInitializer(ABC):
    """Options shared by `Sfm`, `SfmDense` and `Dim`.

    With ``poses=shared`` the points are triangulated under the reference cameras: those that came with the capture, else
    those of the ``reference`` given to `run`. With ``poses=own`` cameras and points are estimated here and then, where a
    reference exists, moved into its gauge by a similarity (``align``).
    """

    name: ClassVar[str]
    is_own_reference: ClassVar[bool] = False  # with poses=shared and no reference: estimate the poses here

    poses: str = "shared"
    align: bool = True
    camera: str = "single"
    camera_model: str = "SIMPLE_RADIAL"
    focal_length: float | None = None
    intrinsics: str = "estimate"
    pairs: str = "exhaustive"
    overlap: int = 10
    neighbors: int = 20
    min_inliers: int = 15
    min_model_size: int = 3
    two_view_tracks: bool = False
    seed: int = 0
    threads: int = 1
    mapper_threads: int = 1

    def __post_init__(self) -> None:
        check_choice("poses", self.poses, POSES)
        check_choice("camera", self.camera, CAMERA_SHARING)
        check_choice("camera_model", self.camera_model, CAMERA_MODELS)
        check_choice("intrinsics", self.intrinsics, INTRINSICS)
        check_choice("pairs", self.pairs, PAIRINGS)
        if self.focal_length is not None:
            check_number("focal_length", self.focal_length, 0, exclusive=True)
        check_integer("overlap", self.overlap, 1, 60)
        check_integer("neighbors", self.neighbors, 1)
        check_integer("min_inliers", self.min_inliers, 7)  # a fundamental matrix takes seven
        check_integer("min_model_size", self.min_model_size, 2)
        check_integer("seed", self.seed, 0, 2**31 - 1)
        check_integer("threads", self.threads, 1)
        check_integer("mapper_threads", self.mapper_threads, 1)

    def needs_reference(self, capture: Capture) -> bool:
        """Whether `run` needs a ``reference`` because the capture came without cameras."""
        shared_without = self.poses == "shared" and not self.is_own_reference
        return capture.model is None and (shared_without or self.intrinsics == "reference")

    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        """Write model and report (see `gsbench.init.base.Initializer`); ``work_dir`` keeps what a killed run had done.

        Raises ``InputError`` where the photos or settings do not give a model.
        """
        if len(capture.image_names) < MIN_IMAGES:
            raise InputError(
                f"scene {capture.name} has {len(capture.image_names)} images: {self.name} needs at least {MIN_IMAGES}"
            )
        if reference is None and self.needs_reference(capture):
            raise InputError(
                f"init={self.name} takes its cameras from a reference, and scene {capture.name} came without: "
                "make one with init=sfm first, or set init.poses=own and init.intrinsics=estimate"
            )
        output_dir.mkdir(parents=True, exist_ok=True)
        with ExitStack() as stack:
            if work_dir is None:
                work_dir = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gsbench-init-")))
            work_dir.mkdir(parents=True, exist_ok=True)
            timer = Timer()
            self.prepare(capture, work_dir, reference, progress, timer)
            job = Job(self, capture, output_dir, work_dir, reference, timer.seconds)
            report = run_with_progress(build_model, job, progress, what=self.name, log=output_dir / LOG_FILE)
        for warning in report.warnings:
            logger.warning("%s: %s", self.name, warning)
        return report

    def prepare(
        self, capture: Capture, work_dir: Path, reference: Path | None, progress: Progress, timer: Timer
    ) -> None:
        """What is done in the calling process, before the isolated one starts. Nothing, unless overridden."""

    @abstractmethod
    def fill_database(
        self,
        database: Path,
        groups: list[CameraGroup],
        pairs: list[tuple[str, str]],
        capture: Capture,
        work_dir: Path,
        progress: Progress,
        timer: Timer,
    ) -> None:
        """Write features, matches and verified geometries; runs in the isolated process."""

    def packages(self) -> tuple[str, ...]:
        """The packages whose versions the report states."""
        return ("pycolmap", "numpy")


def build_model(job: Job, progress: Progress) -> InitReport:
    """Cameras, features, matches, model, report. Calls native code that can abort: run it isolated."""
    import pycolmap

    from gsbench.init import colmap_database, reconstruct, report

    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    options, capture = job.initializer, job.capture
    timer = Timer(dict(job.seconds))
    reference = reconstruct.load_reference(capture, job.reference)
    shared = options.poses == "shared" and reference is not None
    database = job.work_dir / "database.db"
    if reference is not None and (shared or options.intrinsics == "reference"):
        camera_groups = colmap_database.reference_groups(reference)
    else:
        camera_groups = colmap_database.guessed_groups(
            capture.images, capture.image_names, options.camera, options.camera_model, options.focal_length
        )
    groups = colmap_database.create_database(database, camera_groups)
    names = sorted(name for group in groups for name in group.names)
    pairs = reconstruct.select_pairs(capture.images, names, options, reference)
    options.fill_database(database, groups, pairs, capture, job.work_dir, progress, timer)
    counts = colmap_database.database_counts(database)
    if counts["pairs_verified"] == 0:
        raise InputError(
            f"{options.name}: no pair of images shares enough matches: the photos need more overlap or texture"
        )

    settings = reconstruct.MappingSettings(
        options.seed,
        options.mapper_threads,
        options.min_model_size,
        options.two_view_tracks,
        fixed_intrinsics=options.intrinsics == "reference",
    )
    scratch = job.work_dir / "mapping"
    shutil.rmtree(scratch, ignore_errors=True)
    similarity, pose_errors, own_gauge, notes = None, None, None, ()
    with timer.phase("triangulate" if shared else "map"):
        if shared:
            model = reconstruct.triangulate(database, capture.images, scratch, reference, settings, progress)
        else:
            model = reconstruct.map_images(database, capture.images, scratch, settings, progress)
    if not shared and reference is not None:
        similarity = reconstruct.similarity_to(model, reference)
        extent = report.training_extent(model, capture)
        if similarity is None:
            notes = ("too few common cameras with the reference: poses are neither aligned nor compared",)
        else:
            reference_extent = report.training_extent(reference, capture)
            exact = capture.exact_poses and job.reference is None
            pose_errors = report.compare_poses(model, reference, similarity, reference_extent, exact)
            if options.align:
                own_gauge = report.measure_gauge(extent, similarity.scale)
                reconstruct.write_model(model, job.output_dir / OWN_GAUGE_FOLDER)
                reconstruct.apply_similarity(model, similarity)
    reconstruct.write_model(model, job.output_dir / MODEL_FOLDER)
    in_reference_gauge = shared or own_gauge is not None
    scale = 1.0 if in_reference_gauge else None if similarity is None else similarity.scale
    result = InitReport(
        init=options.name,
        poses="shared" if shared else "own",
        **report.model_figures(model, capture),
        gauge=report.measure_gauge(report.training_extent(model, capture), scale),
        own_gauge=own_gauge,
        pose_errors=pose_errors,
        seconds=timer.rounded(),
        settings=asdict(options),
        versions=report.package_versions(*options.packages()),
        counts=counts,
    )
    result = replace(result, warnings=notes + report.find_warnings(result, model))
    result.write(job.output_dir / REPORT_FILE)
    return result
