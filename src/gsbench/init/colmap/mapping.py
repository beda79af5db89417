"""Making a COLMAP model with its report: triangulation, or mapping by the first of several
strategies that succeeds.

COLMAP's defaults need an initial pair that sees points under 16 degrees. Forward-facing captures
with a small baseline have no such pair; COLMAP's global mapper, smaller angles or assumed focal
lengths can still place them. Everything here calls native code that can abort the process: run it
isolated.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap

from gsbench.errors import InputError
from gsbench.init import report
from gsbench.init.base import OWN_GAUGE_FOLDER, InitReport, Preparation, Timer, TrainingPoints
from gsbench.init.colmap import database as colmap_database
from gsbench.init.colmap import reconstruct
from gsbench.init.colmap.alignment import Similarity
from gsbench.logs import Progress
from gsbench.scene.options import MIN_IMAGES
from gsbench.scene.types import Capture

if TYPE_CHECKING:
    from gsbench.init.sfm import ColmapInitializer

SMALL_ANGLE_DEG = 2.0  # triangulation angle of the initial pair; COLMAP's default is 16
# focal length over the longest side: lenses of 27, 36 and 50 mm on 35 mm film
FOCAL_FACTORS = (0.75, 1.0, 1.4)
# median over points of the widest triangulation angle; below it depth is not determined
MIN_ANGLE_DEG = 0.5
NO_PAIR = (
    "structure from motion found no pair of images to start from: the photos need more overlap "
    "(60 % and more "
    "between neighbours), more texture, or a focal length (init.focal_length, px)"
)


@dataclass(frozen=True)
class MappingResult:
    """The best model, its strategy, the number of models of that strategy, and the images that each
    strategy placed."""

    model: pycolmap.Reconstruction
    models: int
    strategy: str
    # strategies in order, each with the number of images that it placed
    tried: tuple[tuple[str, int], ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """One line for the report if COLMAP's defaults were not enough, else none."""
        if len(self.tried) < 2:
            return ()
        counts = ", ".join(f"{strategy} {count}" for strategy, count in self.tried)
        return (
            f"cameras come from the way {self.strategy!r}, since COLMAP's defaults placed too few "
            f"(images: {counts})",
        )


def map_images(
    database: Path, images: Path, output: Path, options: ColmapInitializer, progress: Progress
) -> MappingResult:
    """Estimate cameras and points from the matches in ``database``; returns the model with the most
    images.

    With ``mapper=auto``, the strategies are COLMAP's incremental mapper, the same from a smaller
    initial angle, the global mapper, and assumed focal lengths. The first that places
    `REGISTERED_SHARE` of the images ends the search, and the best model so far wins.

    Raises InputError if no model has at least `MIN_IMAGES` images.
    """
    with pycolmap.Database.open(database) as opened:
        total = opened.num_images()
    best: tuple[pycolmap.Reconstruction, int, str] | None = None
    tried: list[tuple[str, int]] = []
    for strategy, run in _Mapper(database, images, output, options, progress, total).strategies():
        models = [model for model in run() if _is_plausible(model)]
        largest = max(models, key=_model_size, default=None)
        tried.append((strategy, 0 if largest is None else largest.num_reg_images()))
        if largest is not None and (best is None or _model_size(largest) > _model_size(best[0])):
            best = largest, len(models), strategy
        if best is not None and best[0].num_reg_images() >= report.REGISTERED_SHARE * total:
            break
    if best is None:
        raise InputError(NO_PAIR)
    if best[0].num_reg_images() < MIN_IMAGES:
        raise InputError(
            f"structure from motion placed only {best[0].num_reg_images()} of {total} images: the "
            "photos need more "
            "overlap, more texture, or a focal length (init.focal_length, px)"
        )
    return MappingResult(*best, tuple(tried))


Models = Sequence[pycolmap.Reconstruction]


@dataclass(frozen=True)
class _Mapper:
    """COLMAP's mappers, applied to one database of ``total`` images."""

    database: Path
    images: Path
    output: Path
    options: ColmapInitializer
    progress: Progress
    total: int

    def strategies(self) -> Iterator[tuple[str, Callable[[], Models]]]:
        """The strategies that ``init.mapper`` allows, in the order of trying: names and
        functions."""
        mapper = self.options.mapper
        if mapper in ("auto", "incremental"):
            yield "incremental", lambda: self.incremental(self.database)
        if mapper == "auto":
            yield (
                f"incremental from {SMALL_ANGLE_DEG:g} degrees",
                lambda: self.incremental(self.database, SMALL_ANGLE_DEG),
            )
        if mapper in ("auto", "global"):
            yield "global", self.global_mapping
        if mapper == "auto" and colmap_database.cameras_without_prior(self.database):
            for factor in FOCAL_FACTORS:
                yield (
                    f"focal length {factor:g} x the longest side",
                    partial(self.with_assumed_focal_lengths, factor),
                )

    def incremental(self, database: Path, initial_angle: float | None = None) -> Models:
        """Map image by image, from a pair that sees points under ``initial_angle`` degrees (None:
        COLMAP's default)."""
        registered = 0

        def count_image() -> None:
            nonlocal registered
            registered += 1
            self.progress("map", min(registered, self.total), self.total)

        options = reconstruct.pipeline_options(self.options)
        if initial_angle is not None:
            options.mapper.init_min_tri_angle = initial_angle
        run = partial(pycolmap.incremental_mapping, database, next_image_callback=count_image)
        return self._run(run, options)

    def global_mapping(self) -> Models:
        """Map all images together, with COLMAP's global mapper."""
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads = self.options.mapper_threads
        options.random_seed = self.options.seed
        options.min_model_size = self.options.min_model_size
        adjustment = options.mapper.bundle_adjustment
        adjustment.refine_focal_length = self.options.intrinsics == "estimate"
        adjustment.refine_extra_params = self.options.intrinsics == "estimate"
        return self._run(partial(pycolmap.global_mapping, self.database), options)

    def with_assumed_focal_lengths(self, factor: float) -> Models:
        """Map image by image after setting unknown focal lengths to ``factor`` times the longest
        side.

        The pairs are verified again under these focal lengths.
        """
        copy = self.database.with_name(f"assumed-{factor:g}.db")
        shutil.copy(self.database, copy)
        pairs = colmap_database.assume_focal_lengths(copy, factor)
        colmap_database.verify_pairs(
            copy, pairs, reconstruct.verification_options(self.options), self.progress
        )
        return self.incremental(copy, SMALL_ANGLE_DEG)

    def _run(
        self, mapping: Callable[..., dict[int, pycolmap.Reconstruction]], options: Any
    ) -> Models:
        self.progress("map", 0, self.total)
        pycolmap.set_random_seed(self.options.seed)
        models = mapping(self.images, _empty(self.output), options=options)
        self.progress("map", self.total, self.total)
        return list(models.values())


def _empty(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def _model_size(model: pycolmap.Reconstruction) -> tuple[int, int]:
    return model.num_reg_images(), model.num_points3D()


def _is_plausible(model: pycolmap.Reconstruction) -> bool:
    """Return whether triangulation angles determine the depth of points; copies of one photograph
    have none."""
    centers = {
        image.image_id: image.projection_center()
        for image in model.images.values()
        if image.has_pose
    }
    angles = [
        _widest_angle(point, centers)
        for point in model.points3D.values()
        if point.track.length() > 1
    ]
    return bool(angles) and float(np.median(angles)) >= MIN_ANGLE_DEG


def _widest_angle(point: pycolmap.Point3D, centers: dict[int, np.ndarray]) -> float:
    """The widest angle between two rays from a point to its cameras, in degrees."""
    rays = (
        np.array([centers[element.image_id] for element in point.track.elements]) - point.xyz
    )  # [T, 3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1)).max()))


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
    """Make cameras, features, matches, model and report. Calls native code that can abort: run it
    isolated."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)
    options, capture = job.options, job.capture
    timer = Timer(dict(job.preparation.seconds))
    reference = reconstruct.load_reference(capture, job.reference)
    database = job.work_dir / "database.db"
    used = (
        capture.train_names if options.ignores_test_photographs(reference) else capture.image_names
    )
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
            f"{options.name}: no pair of images shares enough matches: the photos need more "
            "overlap or texture"
        )
    scratch = job.work_dir / "mapping"
    shutil.rmtree(scratch, ignore_errors=True)
    if options.poses == "shared" and reference is not None:
        with timer.phase("triangulate"):
            model = reconstruct.triangulate(
                database, images, scratch, reference, names, options, progress
            )
        points = None
        if options.ignores_test_photographs(reference):
            points = TrainingPoints(options.points_from, model.num_points3D(), None, None)
        return _finish(job, "shared", model, reference, None, timer, counts, points=points)
    with timer.phase("map"):
        mapped = map_images(database, images, scratch, options, progress)
    points = None
    if options.points_from == "train":
        points = reconstruct.keep_training_points(mapped.model, capture.train_names, images)
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
    mapped: MappingResult | None = None,
    points: TrainingPoints | None = None,
) -> InitReport:
    """Align the model if its poses were estimated, write it, and make the report."""
    options, capture = job.options, job.capture
    warnings = [*job.preparation.warnings, *(() if mapped is None else mapped.warnings)]
    pose_errors, own_gauge, scale = None, None, 1.0 if poses == "shared" else None
    if poses == "own" and reference is not None and similarity is None:
        warnings.append(
            "too few common cameras with the reference: poses are neither aligned nor compared"
        )
    if reference is not None and similarity is not None:
        exact = capture.exact_poses and job.reference is None
        reference_extent = report.training_extent(reference, capture)
        pose_errors = report.compare_poses(model, reference, similarity, reference_extent, exact)
        scale = similarity.scale
        if options.align:
            own_gauge = report.measure_gauge(report.training_extent(model, capture), scale)
            reconstruct.save_reconstruction(model, job.output_dir / OWN_GAUGE_FOLDER)
            rotation = pycolmap.Rotation3d(similarity.rotation)
            model.transform(pycolmap.Sim3d(similarity.scale, rotation, similarity.translation))
            scale = 1.0
    made = report.make_report(
        options.name,
        poses,
        capture,
        model,
        scale,
        options.packages(),
        warnings,
        settings={**asdict(options), **job.preparation.settings},
        seconds=timer.rounded(),
        own_gauge=own_gauge,
        pose_errors=pose_errors,
        counts=counts,
        mapped_by=None if mapped is None else mapped.strategy,
        training_points=points,
    )
    made = options.extend(model, made)
    report.write_result(model, made, job.output_dir)
    return made
