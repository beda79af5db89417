"""What all initialisers that end in COLMAP share: their options, and the way from matches to a reported model."""

from __future__ import annotations

import logging
import shutil
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Interval
from pydantic import PositiveFloat, PositiveInt

from gsbench.cores import available_cores
from gsbench.errors import InputError
from gsbench.init.base import (
    OWN_GAUGE_FOLDER,
    InitReport,
    Poses,
    Progress,
    Seed,
    no_progress,
)
from gsbench.init.pairs import Pairing
from gsbench.init.relay import run_with_progress
from gsbench.init.timer import Timer
from gsbench.scene.types import Capture
from gsbench.settings import check_settings

if TYPE_CHECKING:
    import pycolmap

    from gsbench.init.alignment import Similarity

logger = logging.getLogger(__name__)

CameraSharing = Literal["single", "per_folder", "per_image"]
CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]
Intrinsics = Literal["estimate", "reference"]
MIN_IMAGES = 3  # two views have no third that could contradict a wrong geometry
MIN_DETECTION_SIZE = 32  # px: below it no detector finds anything
LOG_FILE = "colmap.log"
WORK_FOLDER = "work"


@dataclass(frozen=True)
class Preparation:
    """What was done before COLMAP: its time, its counts and settings for the report, and what deserves a warning."""

    seconds: Mapping[str, float] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Job:
    """One run of an initialiser, as it is handed to the isolated process."""

    initializer: ColmapInitializer
    capture: Capture
    output_dir: Path
    work_dir: Path
    reference: Path | None
    preparation: Preparation


@dataclass(frozen=True)
class DatabaseTask:
    """What is to be filled: the database with cameras and images in it, and the pairs of images to be matched.

    ``images`` is a folder with the same names as the capture's in which COLMAP can read every file.
    """

    database: Path
    images: Path
    names: list[str]
    pairs: list[tuple[str, str]]
    capture: Capture
    work_dir: Path


@dataclass(frozen=True, kw_only=True)
class ColmapInitializer(ABC):
    """Options shared by `Sfm`, `SfmDense` and `Dim`.

    With ``poses=shared`` the points are triangulated under the reference cameras: those of the ``reference`` given to
    `run`, else those that came with the capture. With ``poses=own`` cameras and points are estimated here and then,
    where a reference exists, moved into its gauge by a similarity (``align``).
    """

    name: ClassVar[str]
    is_own_reference: ClassVar[bool] = False  # with poses=shared and no reference: estimate the poses here

    poses: Poses = "shared"
    align: bool = True
    camera: CameraSharing = "single"
    camera_model: CameraModel = "SIMPLE_RADIAL"
    focal_length: PositiveFloat | None = None
    intrinsics: Intrinsics = "estimate"
    pairs: Pairing = "exhaustive"
    overlap: Annotated[int, Interval(ge=1, le=60)] = 10
    neighbors: PositiveInt = 20
    min_inliers: Annotated[int, Ge(7)] = 15  # a fundamental matrix takes seven
    min_model_size: Annotated[int, Ge(2)] = 3
    two_view_tracks: bool = False
    seed: Seed = 0
    threads: PositiveInt | Literal["auto"] = "auto"
    mapper_threads: PositiveInt = 1

    def __post_init__(self) -> None:
        check_settings(self, "init")

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
        """Write model and report (see `gsbench.init.base.Initializer`).

        ``work_dir`` keeps features and matches for a later run; without it they are kept within ``output_dir`` until
        the run succeeds, so that a killed run goes on there.

        Raises ``InputError`` where the photos or settings do not give a model.
        """
        self.check(capture, reference)
        output_dir.mkdir(parents=True, exist_ok=True)
        work = output_dir / WORK_FOLDER if work_dir is None else work_dir
        work.mkdir(parents=True, exist_ok=True)
        preparation = self.prepare(capture, work, reference, progress)
        job = Job(self, capture, output_dir, work, reference, preparation)
        report = run_with_progress(build_model, job, progress, what=self.name, log=output_dir / LOG_FILE)
        if work_dir is None:
            shutil.rmtree(work)
        for warning in report.warnings:
            logger.warning("%s: %s", self.name, warning)
        return report

    def check(self, capture: Capture, reference: Path | None) -> None:
        """Raise ``InputError``, before any work, where this capture cannot be initialised like this."""
        if len(capture.image_names) < MIN_IMAGES:
            raise InputError(
                f"scene {capture.name} has {len(capture.image_names)} images: {self.name} needs at least {MIN_IMAGES}"
            )
        if reference is None and self.needs_reference(capture):
            raise InputError(
                f"init={self.name} takes its cameras from a reference, and scene {capture.name} came without: "
                "make one with init=sfm first, or set init.poses=own and init.intrinsics=estimate"
            )

    def prepare(self, capture: Capture, work_dir: Path, reference: Path | None, progress: Progress) -> Preparation:
        """Work to be done before COLMAP starts; none, unless overridden."""
        return Preparation()

    @abstractmethod
    def fill_database(self, task: DatabaseTask, progress: Progress, timer: Timer) -> None:
        """Write features, matches and verified geometries; runs in the isolated process."""

    @property
    def num_threads(self) -> int:
        """``threads`` as a number; ``auto`` is the cores that this process may use."""
        return available_cores() if self.threads == "auto" else self.threads

    def packages(self) -> tuple[str, ...]:
        """The packages whose versions the report states."""
        return ("pycolmap", "numpy")


def build_model(job: Job, progress: Progress) -> InitReport:
    """Cameras, features, matches, model, report. Calls native code that can abort: run it isolated."""
    import pycolmap

    from gsbench.init import colmap_database, reconstruct

    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    options, capture = job.initializer, job.capture
    timer = Timer(dict(job.preparation.seconds))
    reference = reconstruct.load_reference(capture, job.reference)
    database = job.work_dir / "database.db"
    images = colmap_database.readable_images(capture.images, capture.image_names, job.work_dir)
    if reference is not None and takes_reference_cameras(options):
        cameras = colmap_database.reference_groups(reference)
    else:
        cameras = colmap_database.guessed_groups(
            images, capture.image_names, options.camera, options.camera_model, options.focal_length
        )
    names = list(colmap_database.create_database(database, cameras))
    pairs = reconstruct.select_pairs(capture.images, names, options, reference)
    task = DatabaseTask(database, images, names, pairs, capture, job.work_dir)
    options.fill_database(task, progress, timer)
    counts = {**job.preparation.counts, **colmap_database.database_counts(database)}
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
    if options.poses == "shared" and reference is not None:
        with timer.phase("triangulate"):
            model = reconstruct.triangulate(database, images, scratch, reference, settings, progress)
        return _finish(job, "shared", model, reference, None, timer, counts)
    with timer.phase("map"):
        model, counts["models"] = reconstruct.map_images(database, images, scratch, settings, progress)
    similarity = None if reference is None else reconstruct.similarity_to(model, reference)
    return _finish(job, "own", model, reference, similarity, timer, counts)


def takes_reference_cameras(options: ColmapInitializer) -> bool:
    """Whether the cameras (intrinsics at least) are the reference's where there is one."""
    return options.poses == "shared" or options.intrinsics == "reference"


def select_images(options: ColmapInitializer, capture: Capture, reference: pycolmap.Reconstruction | None) -> list[str]:
    """The sorted names of the images to be used: all, or those that the reference knows where its cameras are taken."""
    if reference is None or not takes_reference_cameras(options):
        return sorted(capture.image_names)
    return sorted(image.name for image in reference.images.values() if image.has_pose)


def _finish(
    job: Job,
    poses: str,
    model: pycolmap.Reconstruction,
    reference: pycolmap.Reconstruction | None,
    similarity: Similarity | None,
    timer: Timer,
    counts: Mapping[str, int],
) -> InitReport:
    """Align the model where it has poses of its own, write it, and report."""
    from gsbench.init import reconstruct, report

    options, capture = job.initializer, job.capture
    warnings = list(job.preparation.warnings)
    pose_errors, own_gauge, scale = None, None, 1.0 if poses == "shared" else None
    if poses == "own" and reference is not None and similarity is None:
        warnings.append("too few common cameras with the reference: poses are neither aligned nor compared")
    if reference is not None and similarity is not None:
        exact = capture.exact_poses and job.reference is None
        reference_extent = report.training_extent(reference, capture)
        pose_errors = report.compare_poses(model, reference, similarity, reference_extent, exact)
        scale = similarity.scale
        if options.align:
            own_gauge = report.measure_gauge(report.training_extent(model, capture), scale)
            reconstruct.write_model(model, job.output_dir / OWN_GAUGE_FOLDER)
            reconstruct.apply_similarity(model, similarity)
            scale = 1.0
    result = report.make_report(
        options.name,
        poses,
        capture,
        model,
        scale,
        settings={**asdict(options), **job.preparation.settings},
        seconds=timer.rounded(),
        packages=options.packages(),
        own_gauge=own_gauge,
        pose_errors=pose_errors,
        counts=counts,
        warnings=warnings,
    )
    report.write_result(model, result, job.output_dir)
    return result
