"""Reconstruction of a COLMAP model: features, matches, mapping or triangulation, alignment."""

from __future__ import annotations

import logging
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from gsbench.errors import InputError
from gsbench.init.base import (
    MODEL_FOLDER,
    OWN_GAUGE_FOLDER,
    REGISTERED_SHARE,
    REPORT_FILE,
    WORK_FOLDER,
    InitReport,
    Preparation,
    Timer,
    TrainingPoints,
    UnplacedError,
)
from gsbench.init.colmap.pairs import ALL_PAIRS_UP_TO
from gsbench.init.options import ColmapOptions
from gsbench.logs import Progress
from gsbench.scene.images import lens_of
from gsbench.scene.rules import MIN_IMAGES
from gsbench.scene.types import Capture
from gsbench.system.isolate import run_with_progress
from gsbench.words import counted, some_of

if TYPE_CHECKING:
    import pycolmap

    from gsbench.init.colmap.database import DatabaseTask
    from gsbench.init.colmap.mapping import MappingResult

logger = logging.getLogger(__name__)

LOG_FILE = "colmap.log"
ALL_PAIRS = "all_pairs"  # below the work folder: the output of a second attempt


@dataclass(frozen=True)
class Job:
    """Inputs of one reconstruction.

    ``work_dir`` keeps features and matches. ``reference`` is a COLMAP model of the same photographs
    whose cameras replace those of the capture.
    """

    options: ColmapOptions
    capture: Capture
    output_dir: Path
    work_dir: Path
    reference: Path | None


# Writes features, matches and verified geometries into the database; returns counts for the report.
Fill = Callable[["DatabaseTask", Job, Progress, Timer], dict[str, int]]


@dataclass(frozen=True)
class Matching:
    """Functions that make features and matches; other processes call them.

    ``fill`` runs in COLMAP's process, ``prepare`` in one of its own before.
    """

    fill: Fill
    prepare: Callable[[Job, Progress], Preparation] | None = None
    packages: tuple[str, ...] = ("pycolmap", "numpy")  # whose versions are in the report


def reconstruct(
    options: ColmapOptions,
    matching: Matching,
    capture: Capture,
    output_dir: Path,
    progress: Progress,
    reference: Path | None,
    work_dir: Path | None,
) -> InitReport:
    """Write model and report (see `Initializer.run`).

    ``work_dir`` keeps features and matches for a later run. Without it, they are kept in
    ``output_dir`` until the run succeeds, so that an interrupted run continues there.

    Raises ``InputError`` if no model can be made from the photographs with these settings.
    """
    check(options, capture, reference)
    if options.takes_cameras_from(capture, reference):
        report_unused(options)
    elif options.camera == "exif":
        report_lenses(capture)
    output_dir.mkdir(parents=True, exist_ok=True)
    work = output_dir / WORK_FOLDER if work_dir is None else work_dir
    work.mkdir(parents=True, exist_ok=True)
    job = Job(options, capture, output_dir, work, reference)
    lacks_pairs = options.pairs == "auto" and len(capture.image_names) > ALL_PAIRS_UP_TO
    try:
        report = run_job(job, matching, progress)
        if lacks_pairs and _placed_few(report):
            report = with_all_pairs(job, matching, progress, report)
    except UnplacedError:
        if not lacks_pairs:
            raise
        everything = replace(job, options=replace(options, pairs="exhaustive"))
        report = run_job(everything, matching, progress)
    if work_dir is None:
        shutil.rmtree(work)
    for warning in report.warnings:
        logger.warning("%s: %s", options.name, warning)
    return report


def run_job(job: Job, matching: Matching, progress: Progress) -> InitReport:
    """Make features, matches and the model, each in a process of its own."""
    prepare, name = matching.prepare, job.options.name
    preparation = Preparation()
    if prepare is not None:
        what = f"{name}: features and matches"
        preparation = run_with_progress(prepare, job, progress, what=what)
    log = job.output_dir / LOG_FILE
    return run_with_progress(
        build_model, (job, matching, preparation), progress, what=name, log=log
    )


def with_all_pairs(
    job: Job, matching: Matching, progress: Progress, report: InitReport
) -> InitReport:
    """Reconstruct again from all pairs; the model that places more images is kept."""
    logger.warning(
        "%s: %d of %d images placed from the pairs of init.pairs=auto: the others are matched, too",
        job.options.name,
        report.num_registered,
        report.num_images,
    )
    second = job.work_dir / ALL_PAIRS
    shutil.rmtree(second, ignore_errors=True)
    second.mkdir()
    everything = replace(job, options=replace(job.options, pairs="exhaustive"), output_dir=second)
    try:
        more = run_job(everything, matching, progress)
    except InputError:  # the first model stays
        return report
    if more.num_registered <= report.num_registered:
        return report
    for name in (MODEL_FOLDER, OWN_GAUGE_FOLDER, Path(REPORT_FILE), Path(LOG_FILE)):
        source, target = second / name, job.output_dir / name
        if source.is_dir():
            shutil.rmtree(target, ignore_errors=True)
            target.parent.mkdir(parents=True, exist_ok=True)
        if source.exists():
            source.replace(target)
    return more


def _placed_few(report: InitReport) -> bool:
    few = report.num_registered < REGISTERED_SHARE * report.num_images
    return report.mapped_by is not None and few


def check(options: ColmapOptions, capture: Capture, reference: Path | None) -> None:
    """Raise ``InputError``, before any work, if this capture does not suit these settings."""
    if len(capture.image_names) < MIN_IMAGES:
        raise InputError(
            f"scene {capture.name} has {counted(len(capture.image_names), 'image')}: "
            f"{options.name} needs at least {MIN_IMAGES}"
        )
    if reference is None and options.needs_reference(capture):
        raise InputError(
            f"init={options.name} takes its cameras from a reference, and scene {capture.name} "
            "came without: make one with init=sfm first, or set init.poses=own and "
            "init.intrinsics=estimate"
        )


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


def build_model(given: tuple[Job, Matching, Preparation], progress: Progress) -> InitReport:
    """Make a model from the photographs, write it, and return the report on it.

    Calls native code that can abort the process: run it isolated.
    """
    import pycolmap

    from gsbench.init.colmap import database, mapping, reconstruct

    # without this, COLMAP logs a line for each image; the log is for warnings
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    job, matching, preparation = given
    options, capture = job.options, job.capture
    timer = Timer(dict(preparation.seconds))
    reference = reconstruct.load_reference(capture, job.reference)
    task = database.create_task(options, capture, reference, job.work_dir)
    found = matching.fill(task, job, progress, timer)
    counts = {**preparation.counts, **found, **database.database_counts(task.database)}
    if counts["pairs_verified"] == 0:
        raise UnplacedError(
            f"{options.name}: no pair of images shares enough matches: the photos need more "
            "overlap or texture"
        )
    # an interrupted mapping is not continued but started again
    scratch = job.work_dir / "mapping"
    shutil.rmtree(scratch, ignore_errors=True)
    mapped = points = None
    if options.poses == "shared" and reference is not None:
        with timer.phase("triangulate"):
            model = mapping.triangulate(
                task.database, task.images, scratch, reference, task.names, options, progress
            )
        if options.ignores_test_photographs(reference):
            points = TrainingPoints(options.points_from, model.num_points3D(), None, None)
    else:
        with timer.phase("map"):
            mapped = mapping.map_images(task.database, task.images, scratch, options, progress)
        model, counts["models"] = mapped.model, mapped.models
        if options.points_from == "train":
            points = reconstruct.keep_training_points(model, capture.train_names, task.images)
    return finish(job, matching, preparation, model, reference, mapped, timer, counts, points)


def finish(
    job: Job,
    matching: Matching,
    preparation: Preparation,
    model: pycolmap.Reconstruction,
    reference: pycolmap.Reconstruction | None,
    mapped: MappingResult | None,
    timer: Timer,
    counts: dict[str, int],
    points: TrainingPoints | None,
) -> InitReport:
    """Align the model if its poses were ``mapped``, not given; write it, and make the report."""
    from gsbench.init import report
    from gsbench.init.colmap.alignment import Alignment, align

    options, capture = job.options, job.capture
    warnings = list(preparation.warnings)
    aligned = Alignment(scale_to_reference=1.0)
    if mapped is not None:
        exact = capture.exact_poses and job.reference is None
        own_gauge = job.output_dir / OWN_GAUGE_FOLDER if options.align else None
        aligned = align(model, reference, capture, exact, own_gauge)
        warnings += [*mapped.warnings(options), *aligned.warnings]
    made = report.make_report(
        options.name,
        "shared" if mapped is None else "own",
        capture,
        model,
        aligned.scale_to_reference,
        matching.packages,
        warnings,
        settings={**asdict(options), **preparation.settings},
        seconds=timer.rounded(),
        own_gauge=aligned.own_gauge,
        pose_errors=aligned.pose_errors,
        counts=counts,
        mapped_by=None if mapped is None else mapped.strategy,
        training_points=points,
    )
    report.write_result(model, made, job.output_dir)
    return made
