"""Reconstruction of a COLMAP model: features, matches, mapping or triangulation, alignment."""

from __future__ import annotations

import logging
import shutil
from abc import abstractmethod
from collections import Counter
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbench.errors import InputError
from gsbench.init.base import (
    OWN_GAUGE_FOLDER,
    REGISTERED_SHARE,
    WORK_FOLDER,
    InitReport,
    Preparation,
    Timer,
    TrainingPoints,
    UnplacedError,
)
from gsbench.init.colmap.pairs import ALL_PAIRS_UP_TO
from gsbench.init.options import ColmapOptions
from gsbench.logs import Progress, no_progress
from gsbench.scene.images import lens_of
from gsbench.scene.rules import MIN_IMAGES
from gsbench.scene.types import Capture
from gsbench.system.isolate import run_isolated
from gsbench.words import counted, some_of

if TYPE_CHECKING:
    import pycolmap

    from gsbench.init.colmap.database import DatabaseTask

logger = logging.getLogger(__name__)

LOG_FILE = "colmap.log"
ALL_PAIRS = "all_pairs"  # below the work folder: the output of a second attempt


@dataclass(frozen=True)
class Job:
    """Inputs of one reconstruction.

    ``work_dir`` keeps features and matches. ``reference`` is a COLMAP model of the same photographs
    whose cameras replace those of the capture.
    """

    options: Reconstruction
    capture: Capture
    output_dir: Path
    work_dir: Path
    reference: Path | None


class Reconstruction(ColmapOptions):
    """Base of the initialisers that reconstruct; subclasses differ in features and matches."""

    @property
    def packages(self) -> tuple[str, ...]:
        """The packages whose versions are in the report."""
        return "pycolmap", "numpy"

    def prepare(self, job: Job, progress: Progress) -> Preparation:
        """Work before COLMAP's process starts, which `fill` uses."""
        return Preparation()

    @abstractmethod
    def fill(
        self, job: Job, task: DatabaseTask, progress: Progress, timer: Timer
    ) -> dict[str, int]:
        """Write features, matches and verified geometries into the database, and return counts.

        It runs in COLMAP's process.
        """

    def check(self, capture: Capture, reference: Path | None) -> None:
        """Raise ``InputError``, before any work, if ``capture`` does not suit these settings."""
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

    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        """See `Initializer.run`.

        ``work_dir`` keeps features and matches for a later run. Without it, they are kept in
        ``output_dir`` until the run succeeds, so that an interrupted run continues there.
        """
        self.check(capture, reference)
        given = self.uses_reference_cameras and (reference or capture.model) is not None
        if given:
            report_unused(self)
        elif self.camera == "exif":
            report_lenses(capture)
        work = output_dir / WORK_FOLDER if work_dir is None else work_dir
        for folder in (output_dir, work):
            folder.mkdir(parents=True, exist_ok=True)
        job, total = Job(self, capture, output_dir, work, reference), len(capture.image_names)
        lacks_pairs = self.pairs == "auto" and total > ALL_PAIRS_UP_TO
        report = None
        try:
            report = run_job(job, progress)
        except UnplacedError:
            if not lacks_pairs:
                raise
        placed = report.num_registered if report else 0
        if report is None or (
            lacks_pairs and report.mapped_by is not None and placed < REGISTERED_SHARE * total
        ):
            logger.warning(
                "%s: %d of %d images placed from the pairs of init.pairs=auto: the others are "
                "matched, too",
                self.name,
                placed,
                total,
            )
            report = with_all_pairs(job, progress, report)
        if work_dir is None:
            shutil.rmtree(work)
        for warning in report.warnings:
            logger.warning("%s: %s", self.name, warning)
        return report


def run_job(job: Job, progress: Progress) -> InitReport:
    """Make features, matches and the model, each in a process of its own."""
    preparation = job.options.prepare(job, progress)
    what, log = job.options.name, job.output_dir / LOG_FILE
    return run_isolated(build_model, (job, preparation), progress=progress, what=what, log=log)


def with_all_pairs(job: Job, progress: Progress, report: InitReport | None) -> InitReport:
    """Reconstruct again from all pairs; the model that places more images is kept."""
    second = job.work_dir / ALL_PAIRS
    shutil.rmtree(second, ignore_errors=True)
    second.mkdir()
    everything = replace(job, options=replace(job.options, pairs="exhaustive"), output_dir=second)
    try:
        more = run_job(everything, progress)
    except InputError:
        if report is None:
            raise
        return report
    if report is not None and more.num_registered <= report.num_registered:
        return report
    shutil.copytree(second, job.output_dir, dirs_exist_ok=True)
    return more


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


def build_model(given: tuple[Job, Preparation], progress: Progress) -> InitReport:
    """Make a model from the photographs, write it, and return the report on it.

    Calls native code that can abort the process: run it isolated.
    """
    import pycolmap

    from gsbench.init import report
    from gsbench.init.colmap import database, reconstruct

    # without this, COLMAP logs a line for each image; the log is for warnings
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    job, preparation = given
    options, capture = job.options, job.capture
    timer = Timer(dict(preparation.seconds))
    reference = reconstruct.load_reference(capture, job.reference)
    task = database.create_task(options, capture, reference, job.work_dir)
    found = options.fill(job, task, progress, timer)
    counts = {**preparation.counts, **found, **database.database_counts(task.database)}
    if counts["pairs_verified"] == 0:
        raise UnplacedError(
            f"{options.name}: no pair of images shares enough matches: the photos need more "
            "overlap or texture"
        )
    model, poses, further = _cameras_and_points(job, task, reference, timer, progress)
    counts |= further.pop("counts", {})
    warnings = [*preparation.warnings, *further.pop("warnings", ())]
    made = report.make_report(
        options.name,
        poses,
        capture,
        model,
        options.packages,
        warnings,
        settings={**asdict(options), **preparation.settings},
        seconds=timer.rounded(),
        counts=counts,
        **further,
    )
    report.write_result(model, made, job.output_dir)
    return made


def _cameras_and_points(
    job: Job,
    task: DatabaseTask,
    reference: pycolmap.Reconstruction | None,
    timer: Timer,
    progress: Progress,
) -> tuple[pycolmap.Reconstruction, str, dict[str, Any]]:
    """Triangulate under the reference's cameras, or map: the model, its poses, and more facts."""
    from gsbench.init.colmap import mapping, reconstruct
    from gsbench.init.colmap.alignment import align

    options, capture = job.options, job.capture
    # an interrupted mapping is not continued but started again
    scratch = job.work_dir / "mapping"
    shutil.rmtree(scratch, ignore_errors=True)
    if options.poses == "shared" and reference is not None:
        points = None
        with timer.phase("triangulate"):
            model = mapping.triangulate(task, scratch, reference, options, progress)
        if options.ignores_test_photographs(reference):
            points = TrainingPoints(options.points_from, model.num_points3D(), None, None)
        return model, "shared", {"scale_to_reference": 1.0, "training_points": points}
    with timer.phase("map"):
        model, counts, strategy, warnings = mapping.map_images(task, scratch, options, progress)
    further: dict[str, Any] = {"counts": {"models": counts}, "mapped_by": strategy}
    if options.points_from == "train":
        points = reconstruct.keep_training_points(model, capture.train_names, task.images)
        further["training_points"] = points
    own_gauge = job.output_dir / OWN_GAUGE_FOLDER if options.align else None
    exact = capture.exact_poses and job.reference is None
    further |= align(model, reference, capture, exact, own_gauge)
    further["warnings"] = [*warnings, *further.get("warnings", ())]
    return model, "own", further
