"""Reconstruction of a COLMAP model with its report. It calls native code that can abort: run it isolated."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pycolmap

from gsbench.errors import InputError
from gsbench.init import report
from gsbench.init.base import OWN_GAUGE_FOLDER, InitReport, Preparation, Timer, TrainingPoints
from gsbench.init.colmap import database as colmap_database
from gsbench.init.colmap import mapping, reconstruct
from gsbench.init.colmap.alignment import Similarity
from gsbench.init.colmap.reconstruct import keep_training_points
from gsbench.logs import Progress
from gsbench.scene.types import Capture

if TYPE_CHECKING:
    from gsbench.init.colmap.initializer import ColmapInitializer


@dataclass(frozen=True)
class ReconstructionJob:
    """Inputs of one run of an initialiser in its isolated process."""

    options: ColmapInitializer
    capture: Capture
    output_dir: Path
    work_dir: Path
    reference: Path | None
    preparation: Preparation


def build_model(job: ReconstructionJob, progress: Progress) -> InitReport:
    """Make cameras, features, matches, model and report. Calls native code that can abort: run it isolated."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    options, capture = job.options, job.capture
    timer = Timer(dict(job.preparation.seconds))
    reference = reconstruct.load_reference(capture, job.reference)
    database = job.work_dir / "database.db"
    used = capture.train_names if options.ignores_test_photographs(reference) else capture.image_names
    images = colmap_database.readable_images(capture.images, used, job.work_dir)
    if reference is not None and options.uses_reference_cameras:
        groups = colmap_database.reference_camera_groups(reference)
    else:
        groups = colmap_database.unknown_camera_groups(
            images, capture.image_names, options.camera, options.camera_model, options.focal_length
        )
    image_ids = colmap_database.create_database(database, groups)
    names = [name for name in image_ids if name in set(used)]
    pairs = reconstruct.select_pairs(names, options)
    task = colmap_database.DatabaseTask(database, images, names, pairs, capture, job.work_dir)
    counts = options.fill_database(task, progress, timer)
    counts = {**job.preparation.counts, **counts, **colmap_database.database_counts(database)}
    if counts["pairs_verified"] == 0:
        raise InputError(
            f"{options.name}: no pair of images shares enough matches: the photos need more overlap or texture"
        )
    scratch = job.work_dir / "mapping"
    shutil.rmtree(scratch, ignore_errors=True)
    if options.poses == "shared" and reference is not None:
        with timer.phase("triangulate"):
            model = reconstruct.triangulate(database, images, scratch, reference, names, options, progress)
        points = None
        if options.ignores_test_photographs(reference):
            points = TrainingPoints(options.points_from, model.num_points3D(), None, None)
        return _finish(job, "shared", model, reference, None, timer, counts, points=points)
    with timer.phase("map"):
        mapped = mapping.map_images(database, images, scratch, options, progress)
    points = None
    if options.points_from == "train":
        points = keep_training_points(mapped.model, capture.train_names, images)
    similarity = None if reference is None else reconstruct.similarity_to(mapped.model, reference)
    counts["models"] = mapped.models
    return _finish(job, "own", mapped.model, reference, similarity, timer, counts, mapped, points)


def _finish(
    job: ReconstructionJob,
    poses: str,
    model: pycolmap.Reconstruction,
    reference: pycolmap.Reconstruction | None,
    similarity: Similarity | None,
    timer: Timer,
    counts: Mapping[str, int],
    mapped: mapping.MappingResult | None = None,
    points: TrainingPoints | None = None,
) -> InitReport:
    """Align the model if its poses were estimated, write it, and make the report."""
    options, capture = job.options, job.capture
    warnings = [*job.preparation.warnings, *(() if mapped is None else mapped.warnings)]
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
            reconstruct.save_reconstruction(model, job.output_dir / OWN_GAUGE_FOLDER)
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
        mapped_by=None if mapped is None else mapped.strategy,
        warnings=warnings,
        training_points=points,
    )
    report.write_result(model, result, job.output_dir)
    return result
