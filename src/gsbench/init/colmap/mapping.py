"""Cameras and points from verified matches: triangulation under known cameras, or mapping.

COLMAP's defaults need an initial pair that sees points under 16 degrees. Forward-facing captures
with a small baseline have no such pair; COLMAP's global mapper, smaller angles or assumed focal
lengths can still place them. Everything here calls native code that can abort the process: run it
isolated.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from gsbench.errors import InputError
from gsbench.init.base import REGISTERED_SHARE, UnplacedError
from gsbench.init.colmap import database as colmap_database
from gsbench.init.colmap import matches
from gsbench.init.options import ColmapOptions
from gsbench.logs import Progress
from gsbench.scene.rules import MIN_IMAGES
from gsbench.scene.types import Array

SMALL_ANGLE_DEG = 2.0  # triangulation angle of the initial pair; COLMAP's default is 16
# focal length over the longest side: lenses of 27, 36 and 50 mm on 35 mm film
FOCAL_FACTORS = (0.75, 1.0, 1.4)
# median over points of the widest triangulation angle; below it depth is not determined
MIN_ANGLE_DEG = 0.5
# Depths in one model: the 95th over the 5th percentile of the images' median depths. 7 is the
# largest of the sound captures that were tried; a macro photograph and a drone's differ by 500. In
# a collapsed model some cameras lie in one point, and others thousands of times as far.
MAX_DEPTH_SPREAD = 1000.0
NO_PAIR = (
    "structure from motion found no pair of images to start from: the photos need more overlap (60 "
    "% and more between neighbours), more texture, or a focal length (init.focal_length, px)"
)


@dataclass(frozen=True)
class Geometry:
    """Measurements of the points of a model, which say whether its cameras are sound."""

    images: int  # that see a point
    points: int
    # degrees: the median over points of the widest angle between two of its rays; NaN without one
    angle: float
    depth_spread: float  # see `MAX_DEPTH_SPREAD`

    @property
    def fault(self) -> str:
        """The reason why the model is wrong, although its images have poses; "" if it is sound."""
        if self.images == 0:
            return "no image sees a point"
        if not self.angle >= MIN_ANGLE_DEG:  # the rays of equal images, too
            return f"rays to its points meet at less than {MIN_ANGLE_DEG:g} degrees"
        if not self.depth_spread <= MAX_DEPTH_SPREAD:
            return f"collapsed: depths of its images differ by a factor of {self.depth_spread:,.0f}"
        return ""


@dataclass(frozen=True)
class Attempt:
    """The largest model of a strategy: the images that it places, and its fault or ""."""

    strategy: str
    images: int
    fault: str

    def __str__(self) -> str:
        note = f" ({self.fault})" if self.fault else ""
        return f"{self.strategy} {self.images}{note}"


@dataclass(frozen=True)
class MappingResult:
    """The best model, the strategy that made it, and how many models that strategy made."""

    model: pycolmap.Reconstruction
    models: int
    strategy: str
    tried: tuple[Attempt, ...]  # in order

    def warnings(self, options: ColmapOptions) -> tuple[str, ...]:
        """One line for the report if COLMAP's defaults were not enough, else none."""
        if len(self.tried) < 2:
            return ()
        counts = ", ".join(map(str, self.tried))
        return (
            f"cameras come from the strategy {self.strategy!r}: COLMAP's defaults placed too few "
            f"(images: {counts}){_remedy(options)}",
        )


def map_images(
    database: Path, images: Path, output: Path, options: ColmapOptions, progress: Progress
) -> MappingResult:
    """Estimate cameras and points from the matches in ``database``: the largest sound model.

    With ``mapper=auto``, the strategies are COLMAP's incremental mapper, the same from a smaller
    initial angle, the global mapper, and assumed focal lengths. The first with a sound model
    (`Geometry.fault`) of `REGISTERED_SHARE` of the images ends the search, and the best model so
    far wins. Images that see no point count for nothing.

    Raises UnplacedError if no sound model has at least `MIN_IMAGES` images.
    """
    with pycolmap.Database.open(database) as opened:
        total = opened.num_images()
    best: tuple[pycolmap.Reconstruction, int, str] | None = None
    best_size = (0, 0)
    tried: list[Attempt] = []
    for strategy, run in _Mapper(database, images, output, options, progress, total).strategies():
        models = [(measure_geometry(model), model) for model in run()]
        sound = [(geometry, model) for geometry, model in models if not geometry.fault]
        largest = max(sound or models, key=lambda made: _size(made[0]), default=None)
        if largest is None:
            tried.append(Attempt(strategy, 0, ""))
            continue
        geometry, model = largest
        tried.append(Attempt(strategy, geometry.images, geometry.fault))
        if sound and (best is None or _size(geometry) > best_size):
            best, best_size = (model, len(sound), strategy), _size(geometry)
        if best_size[0] >= REGISTERED_SHARE * total:
            break
    if best is None and (faults := [attempt for attempt in tried if attempt.fault]):
        raise UnplacedError(
            f"structure from motion made no sound model of {total} images ("
            f"{', '.join(map(str, faults))}): the photos need more overlap or more texture"
            f"{_remedy(options)}"
        )
    if best is None:
        raise UnplacedError(NO_PAIR)
    if best_size[0] < MIN_IMAGES:
        raise UnplacedError(
            f"structure from motion placed only {best_size[0]} of {total} images: the "
            "photos need more overlap, more texture, or a focal length (init.focal_length, px)"
        )
    return MappingResult(*best, tuple(tried))


def _remedy(options: ColmapOptions) -> str:
    """What else may place more images; "" if all pairs were matched."""
    return "" if options.pairs == "exhaustive" else "; init.pairs=exhaustive may place more"


Models = Sequence[pycolmap.Reconstruction]


@dataclass(frozen=True)
class _Mapper:
    """COLMAP's mappers, applied to one database of ``total`` images."""

    database: Path
    images: Path
    output: Path
    options: ColmapOptions
    progress: Progress
    total: int

    def strategies(self) -> Iterator[tuple[str, Callable[[], Models]]]:
        """The strategies of ``init.mapper`` in the order of trying: names and functions."""
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
        """Map image by image, from a pair under ``initial_angle`` degrees (None: COLMAP's)."""
        registered = 0

        def count_image() -> None:
            nonlocal registered
            registered += 1
            self.progress("map", min(registered, self.total), self.total)

        options = pipeline_options(self.options)
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
        """Map image by image, with unknown focal lengths of ``factor`` times the longest side.

        The pairs are verified again under these focal lengths.
        """
        copy = self.database.with_name(f"assumed-{factor:g}.db")
        colmap_database.remove_database(copy)
        shutil.copy(self.database, copy)
        pairs = colmap_database.assume_focal_lengths(copy, factor)
        options = matches.verification_options(self.options)
        matches.verify_pairs(copy, pairs, options, self.progress)
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


def _size(geometry: Geometry) -> tuple[int, int]:
    return geometry.images, geometry.points


def measure_geometry(model: pycolmap.Reconstruction) -> Geometry:
    """Measure the rays and depths of a model."""
    poses = {image.image_id: image for image in model.images.values() if image.has_pose}
    centers = {image_id: image.projection_center() for image_id, image in poses.items()}
    axes = {image_id: image.viewing_direction() for image_id, image in poses.items()}
    depths: dict[int, list[float]] = {}  # of the points that each image sees
    angles = []
    for point in model.points3D.values():
        seen_by = [element.image_id for element in point.track.elements]
        rays = point.xyz - np.array([centers[image_id] for image_id in seen_by]).reshape(-1, 3)
        for image_id, ray in zip(seen_by, rays, strict=True):  # [3]
            depths.setdefault(image_id, []).append(float(ray @ axes[image_id]))
        if len(seen_by) > 1:
            angles.append(_widest_angle(rays))
    # no depth is 0 or less in a sound model, so such a median makes the spread infinite
    medians = [float(np.median(own)) for own in depths.values()]
    low, high = np.percentile(medians, [5, 95]) if medians else (math.nan, math.nan)
    return Geometry(
        images=len(depths),
        points=model.num_points3D(),
        angle=float(np.median(angles)) if angles else math.nan,
        depth_spread=float(high / low) if low > 0 else math.inf,
    )


def _widest_angle(rays: Array) -> float:
    """The widest angle between two rays [T, 3], in degrees."""
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1)).max()))


def triangulate(
    database: Path,
    images: Path,
    output: Path,
    reference: pycolmap.Reconstruction,
    names: Collection[str],
    options: ColmapOptions,
    progress: Progress,
) -> pycolmap.Reconstruction:
    """Triangulate the verified matches of the images ``names`` under the reference's fixed cameras.

    The other images of the database are in the model with their cameras, but see no point.
    """
    progress("triangulate", 0, 1)
    posed, unused = pycolmap.Reconstruction(), []  # both with the ids of the database
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            posed.add_camera_with_trivial_rig(camera)
        for stored in opened.read_all_images():
            pose = reference.find_image_with_name(stored.name).cam_from_world()
            image = pycolmap.Image(
                name=stored.name, camera_id=stored.camera_id, image_id=stored.image_id
            )
            if stored.name in names:
                posed.add_image_with_trivial_frame(image, pose)
            else:
                unused.append((image, pose))
    # COLMAP has a random generator for the whole process, besides the seeds in its options
    pycolmap.set_random_seed(options.seed)
    output.mkdir(parents=True, exist_ok=True)
    model = pycolmap.triangulate_points(
        posed,
        database,
        images,
        output,
        clear_points=True,
        options=pipeline_options(options),
        refine_intrinsics=False,
    )
    progress("triangulate", 1, 1)
    if model.num_points3D() == 0:
        raise InputError(
            "no point could be triangulated under the reference cameras: the matches contradict "
            "them (are they the cameras of these photos?), or the photos have too little texture "
            "or overlap"
        )
    # On some processors the solver changes the fixed poses by a rounding error.
    for image in model.images.values():
        pose = reference.find_image_with_name(image.name).cam_from_world()
        image.frame.set_cam_from_world(image.camera_id, pose)
    for image, pose in unused:
        model.add_image_with_trivial_frame(image, pose)
    return model


def pipeline_options(options: ColmapOptions) -> pycolmap.IncrementalPipelineOptions:
    """The options of COLMAP's incremental mapper, which its triangulator reads too."""
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.num_threads = pipeline.mapper.num_threads = options.mapper_threads
    pipeline.triangulation.ignore_two_view_tracks = not options.two_view_tracks
    for part in (pipeline, pipeline.mapper, pipeline.triangulation):
        part.random_seed = options.seed
    # mapping must not stop at a first model of a few images (see map_images)
    pipeline.multiple_models = True
    pipeline.min_model_size = options.min_model_size
    refine = options.intrinsics == "estimate"
    pipeline.ba_refine_focal_length = pipeline.ba_refine_extra_params = refine
    mapper = pipeline.mapper
    mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = refine
    return pipeline
