"""The steps of every initialiser that reconstructs with COLMAP.

Preparation, database, features and matches, mapping or triangulation, alignment, report.
"""

from __future__ import annotations

import logging
import shutil
from abc import abstractmethod
from collections import Counter
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from gsbench.errors import InputError
from gsbench.init.base import (
    OWN_GAUGE_FOLDER,
    WORK_FOLDER,
    InitReport,
    Preparation,
    Timer,
    TrainingPoints,
)
from gsbench.init.options import ColmapOptions
from gsbench.logs import Progress, no_progress
from gsbench.scene.exif import lens_of
from gsbench.scene.options import MIN_IMAGES
from gsbench.scene.types import Capture
from gsbench.system.isolate import run_with_progress
from gsbench.words import counted, some_of

if TYPE_CHECKING:
    import pycolmap

    from gsbench.init.colmap.database import DatabaseTask
    from gsbench.init.colmap.mapping import MappingResult

logger = logging.getLogger(__name__)

LOG_FILE = "colmap.log"


@dataclass(frozen=True, kw_only=True)
class ColmapInitializer(ColmapOptions):
    """Base of `Sfm`, `SfmDense`, `Dim` and `SiftKornia`, which differ in features and matches."""

    # estimates the poses itself if poses=shared and there is no reference
    is_own_reference: ClassVar[bool] = False

    @abstractmethod
    def fill_database(self, task: DatabaseTask, progress: Progress, timer: Timer) -> dict[str, int]:
        """Write features, matches and verified geometries; returns counts for the report."""

    def packages(self) -> tuple[str, ...]:
        """The packages whose versions are in the report."""
        return ("pycolmap", "numpy")

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
        if self.takes_cameras_from(capture, reference):
            report_unused(self)
        elif self.camera == "exif":
            report_lenses(capture)
        output_dir.mkdir(parents=True, exist_ok=True)
        work = output_dir / WORK_FOLDER if work_dir is None else work_dir
        work.mkdir(parents=True, exist_ok=True)
        preparation = self.prepare(capture, work, reference, progress)
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
        """Raise ``InputError``, before any work, if this capture does not suit these settings."""
        if len(capture.image_names) < MIN_IMAGES:
            raise InputError(
                f"scene {capture.name} has {counted(len(capture.image_names), 'image')}: "
                f"{self.name} needs at least {MIN_IMAGES}"
            )
        if reference is None and self.needs_reference(capture):
            raise InputError(
                f"init={self.name} takes its cameras from a reference, and scene {capture.name} "
                "came without: make one with init=sfm first, or set init.poses=own and "
                "init.intrinsics=estimate"
            )

    def prepare(
        self, capture: Capture, work_dir: Path, reference: Path | None, progress: Progress
    ) -> Preparation:
        """Do the work that comes before COLMAP; none by default."""
        return Preparation()

    def extend(self, model: pycolmap.Reconstruction, report: InitReport) -> InitReport:
        """Change the model before it is written; returns its report. Runs isolated."""
        return report


def report_unused(options: ColmapOptions) -> None:
    """Write a line on each setting for cameras to be estimated, where cameras are given."""
    for entry in fields(ColmapOptions):
        value = getattr(options, entry.name)
        if entry.name in ("camera", "camera_model", "focal_length") and value != entry.default:
            logger.warning(
                "init.%s=%s is not used, since the cameras are given: init.poses=own "
                "init.intrinsics=estimate estimates them",
                entry.name,
                value,
            )


def report_lenses(capture: Capture) -> None:
    """Write one line if the photographs have several lenses or zooms, which get cameras each."""
    counts = Counter(str(lens_of(capture.images / name)) for name in capture.image_names)
    if len(counts) > 1:
        logger.warning(
            "%s: by EXIF, the photographs have %d focal lengths or lenses, and get a camera for "
            "each: %s; init.camera=single shares one",
            capture.images,
            len(counts),
            some_of([f"{lens}: {count}" for lens, count in counts.most_common()]),
        )


@dataclass(frozen=True)
class ReconstructionJob:
    """Inputs of one run of an initialiser in its isolated process."""

    initializer: ColmapInitializer
    capture: Capture
    output_dir: Path
    work_dir: Path
    reference: Path | None
    preparation: Preparation


def build_model(job: ReconstructionJob, progress: Progress) -> InitReport:
    """Make a model from the photographs, write it, and return the report on it.

    Calls native code that can abort the process: run it isolated.
    """
    import pycolmap

    from gsbench.init.colmap import database, mapping, reconstruct

    # without this, COLMAP logs a line for each image; the log is for warnings
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    initializer, capture = job.initializer, job.capture
    timer = Timer(dict(job.preparation.seconds))
    reference = reconstruct.load_reference(capture, job.reference)
    task = database.create_task(initializer, capture, reference, job.work_dir)
    found = initializer.fill_database(task, progress, timer)
    counts = {**job.preparation.counts, **found, **database.database_counts(task.database)}
    if counts["pairs_verified"] == 0:
        raise InputError(
            f"{initializer.name}: no pair of images shares enough matches: the photos need more "
            "overlap or texture"
        )
    # an interrupted mapping is not continued but started again
    scratch = job.work_dir / "mapping"
    shutil.rmtree(scratch, ignore_errors=True)
    mapped = points = None
    if initializer.poses == "shared" and reference is not None:
        with timer.phase("triangulate"):
            model = mapping.triangulate(
                task.database, task.images, scratch, reference, task.names, initializer, progress
            )
        if initializer.ignores_test_photographs(reference):
            points = TrainingPoints(initializer.points_from, model.num_points3D(), None, None)
    else:
        with timer.phase("map"):
            mapped = mapping.map_images(task.database, task.images, scratch, initializer, progress)
        model, counts["models"] = mapped.model, mapped.models
        if initializer.points_from == "train":
            points = reconstruct.keep_training_points(model, capture.train_names, task.images)
    return finish(job, model, reference, mapped, timer, counts, points)


def finish(
    job: ReconstructionJob,
    model: pycolmap.Reconstruction,
    reference: pycolmap.Reconstruction | None,
    mapped: MappingResult | None,
    timer: Timer,
    counts: dict[str, int],
    points: TrainingPoints | None = None,
) -> InitReport:
    """Align the model if its poses were ``mapped``, not given; write it, and make the report."""
    from gsbench.init import report
    from gsbench.init.colmap.alignment import Alignment, align

    initializer, capture = job.initializer, job.capture
    warnings = list(job.preparation.warnings)
    aligned = Alignment(scale_to_reference=1.0)
    if mapped is not None:
        exact = capture.exact_poses and job.reference is None
        own_gauge = job.output_dir / OWN_GAUGE_FOLDER if initializer.align else None
        aligned = align(model, reference, capture, exact, own_gauge)
        warnings += [*mapped.warnings, *aligned.warnings]
    made = report.make_report(
        initializer.name,
        "shared" if mapped is None else "own",
        capture,
        model,
        aligned.scale_to_reference,
        initializer.packages(),
        warnings,
        settings={**asdict(initializer), **job.preparation.settings},
        seconds=timer.rounded(),
        own_gauge=aligned.own_gauge,
        pose_errors=aligned.pose_errors,
        counts=counts,
        mapped_by=None if mapped is None else mapped.strategy,
        training_points=points,
    )
    made = initializer.extend(model, made)
    report.write_result(model, made, job.output_dir)
    return made
