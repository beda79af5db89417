"""Cameras and points from verified matches: triangulation under known cameras, or mapping.

COLMAP's defaults need an initial pair that sees points under 16 degrees. Forward-facing captures
with a small baseline have no such pair; COLMAP's global mapper, smaller angles or assumed focal
lengths can still place them. Everything here calls native code that can abort the process: run it
isolated.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pycolmap

from gsbench.errors import InputError
from gsbench.init.base import REGISTERED_SHARE, UnplacedError
from gsbench.init.colmap import database as colmap_database
from gsbench.init.colmap import matches
from gsbench.init.colmap.database import DatabaseTask
from gsbench.init.options import ColmapOptions
from gsbench.logs import Progress
from gsbench.scene.colmap import posed_images
from gsbench.scene.rules import MIN_IMAGES

SMALL_ANGLE_DEG = 2.0  # triangulation angle of the initial pair; COLMAP's default is 16
# focal length over the longest side: lenses of 27, 36 and 50 mm on 35 mm film
FOCAL_FACTORS = (0.75, 1.0, 1.4)
# median over points of the widest triangulation angle; below it depth is not determined
MIN_ANGLE_DEG = 0.5
# Depths in one model: the 95th over the 5th percentile of the images' median depths. 7 is the
# largest of the sound captures that were tried; a macro photograph and a drone's differ by 500. In
# a collapsed model some cameras lie in one point, and others thousands of times as far.
MAX_DEPTH_SPREAD = 1000.0


@dataclass(frozen=True)
class Geometry:
    """Measurements of the points of a model, which say whether its cameras are sound."""

    images: int  # that see a point
    points: int
    # degrees: the median over points of the widest angle between two of its rays; NaN without one
    angle: float
    depth_spread: float  # see `MAX_DEPTH_SPREAD`

    @property
    def size(self) -> tuple[int, int]:
        return self.images, self.points

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


class Mapped(NamedTuple):
    """The best model, how many models its strategy made, the strategy, and lines for the report."""

    model: pycolmap.Reconstruction
    models: int
    strategy: str
    warnings: list[str]


def map_images(
    task: DatabaseTask, output: Path, options: ColmapOptions, progress: Progress
) -> Mapped:
    """Estimate cameras and points from the matches in the database: the largest sound model.

    With ``mapper=auto``, the strategies are COLMAP's incremental mapper, the same from a smaller
    initial angle, the global mapper, and assumed focal lengths. The first with a sound model
    (`Geometry.fault`) of `REGISTERED_SHARE` of the images ends the search, and the best model so
    far wins. Images that see no point count for nothing.

    Raises UnplacedError if no sound model has at least `MIN_IMAGES` images.
    """
    with pycolmap.Database.open(task.database) as opened:
        total = opened.num_images()
    remedy = "" if options.pairs == "exhaustive" else "; init.pairs=exhaustive may place more"
    best, best_size = None, (0, 0)
    tried: list[str] = []  # each strategy with the images of its largest model, and its fault
    faulty: list[str] = []
    for strategy, models in _Mapper(task, output, options, progress, total).strategies():
        made = [(measure_geometry(model), model) for model in models]
        sound = [one for one in made if not one[0].fault]
        tried.append(f"{strategy} 0")
        if made:
            geometry, model = max(sound or made, key=lambda one: one[0].size)
            tried[-1] = f"{strategy} {geometry.images}"
            if not sound:
                tried[-1] += f" ({geometry.fault})"
                faulty.append(tried[-1])
            elif geometry.size > best_size:
                best, best_size = Mapped(model, len(sound), strategy, []), geometry.size
        if best_size[0] >= REGISTERED_SHARE * total:
            break
    if best is None and faulty:
        raise UnplacedError(
            f"structure from motion made no sound model of {total} images ({', '.join(faulty)}): "
            f"the photos need more overlap or more texture{remedy}"
        )
    if best is None or best_size[0] < MIN_IMAGES:
        raise UnplacedError(
            f"structure from motion placed only {best_size[0]} of {total} images: the photos need "
            "more overlap (60 % and more between neighbours), more texture, or a focal length "
            "(init.focal_length, px)"
        )
    if len(tried) > 1:
        best.warnings.append(
            f"cameras come from the strategy {best.strategy!r}: COLMAP's defaults placed too few "
            f"(images: {', '.join(tried)}){remedy}"
        )
    return best


Models = Sequence[pycolmap.Reconstruction]


@dataclass(frozen=True)
class _Mapper:
    """COLMAP's mappers, applied to one database of ``total`` images."""

    task: DatabaseTask
    output: Path
    options: ColmapOptions
    progress: Progress
    total: int

    def strategies(self) -> Iterator[tuple[str, Models]]:
        """The strategies of ``init.mapper`` with their models; each runs when it is reached."""
        mapper, database = self.options.mapper, self.task.database
        if mapper != "global":
            yield "incremental", self.incremental(database)
        if mapper == "auto":
            small = SMALL_ANGLE_DEG
            yield f"incremental from {small:g} degrees", self.incremental(database, small)
        if mapper != "incremental":
            yield "global", self.global_mapping()
        if mapper == "auto" and colmap_database.cameras_without_prior(database):
            for factor in FOCAL_FACTORS:
                assumed = self.with_assumed_focal_lengths(factor)
                yield f"focal length {factor:g} x the longest side", assumed

    def incremental(self, database: Path, initial_angle: float | None = None) -> Models:
        """Map image by image, from a pair under ``initial_angle`` degrees (None: COLMAP's)."""
        registered = count(1)

        def count_image() -> None:
            self.progress("map", min(next(registered), self.total), self.total)

        options = pipeline_options(self.options)
        if initial_angle is not None:
            options.mapper.init_min_tri_angle = initial_angle
        run = partial(pycolmap.incremental_mapping, database, next_image_callback=count_image)
        return self._run(run, options)

    def global_mapping(self) -> Models:
        """Map all images together, with COLMAP's global mapper."""
        options = pycolmap.GlobalPipelineOptions(
            {
                "num_threads": self.options.mapper_threads,
                "random_seed": self.options.seed,
                "min_model_size": MIN_IMAGES,
            }
        )
        return self._run(partial(pycolmap.global_mapping, self.task.database), options)

    def with_assumed_focal_lengths(self, factor: float) -> Models:
        """Map image by image, with unknown focal lengths of ``factor`` times the longest side.

        The pairs are verified again under these focal lengths.
        """
        copy = self.task.database.with_name(f"assumed-{factor:g}.db")
        colmap_database.remove_database(copy)
        shutil.copy(self.task.database, copy)
        colmap_database.assume_focal_lengths(copy, factor)
        matches.verify_pairs(copy, self.options, self.progress)
        return self.incremental(copy, SMALL_ANGLE_DEG)

    def _run(
        self, mapping: Callable[..., dict[int, pycolmap.Reconstruction]], options: Any
    ) -> Models:
        self.progress("map", 0, self.total)
        pycolmap.set_random_seed(self.options.seed)
        shutil.rmtree(self.output, ignore_errors=True)
        self.output.mkdir(parents=True)
        models = mapping(self.task.images, self.output, options=options)
        self.progress("map", self.total, self.total)
        return list(models.values())


def measure_geometry(model: pycolmap.Reconstruction) -> Geometry:
    """Measure the rays and depths of a model."""
    centers, depths, angles = {}, [], []
    for image in posed_images(model).values():
        centers[image.image_id] = image.projection_center()
        seen = [model.points3D[at.point3D_id].xyz for at in image.get_observation_points2D()]
        if seen:
            depths.append(float(np.median((image.cam_from_world() * np.array(seen))[:, 2])))
    for point in model.points3D.values():
        seen_from = [centers[element.image_id] for element in point.track.elements]
        if len(seen_from) > 1:
            rays = point.xyz - np.array(seen_from)
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            angles.append(np.degrees(np.arccos(np.clip(rays @ rays.T, -1, 1)).max()))  # widest
    low, high = np.percentile(depths, [5, 95]) if depths else (math.nan, math.nan)
    return Geometry(
        images=len(depths),
        points=model.num_points3D(),
        angle=float(np.median(angles)) if angles else math.nan,
        # no depth is 0 or less in a sound model
        depth_spread=float(high / low) if low > 0 else math.inf,
    )


def triangulate(
    task: DatabaseTask,
    output: Path,
    reference: pycolmap.Reconstruction,
    options: ColmapOptions,
    progress: Progress,
) -> pycolmap.Reconstruction:
    """Triangulate the verified matches of the task's images under the reference's fixed cameras.

    The other images of the database are in the model with their cameras, but see no point.
    """
    progress("triangulate", 0, 1)
    posed, unused = pycolmap.Reconstruction(), []  # both with the ids of the database
    with pycolmap.Database.open(task.database) as opened:
        for camera in opened.read_all_cameras():
            posed.add_camera_with_trivial_rig(camera)
        for stored in opened.read_all_images():
            pose = reference.find_image_with_name(stored.name).cam_from_world()
            image = pycolmap.Image(
                name=stored.name, camera_id=stored.camera_id, image_id=stored.image_id
            )
            if stored.name in task.names:
                posed.add_image_with_trivial_frame(image, pose)
            else:
                unused.append((image, pose))
    # COLMAP has a random generator for the whole process, besides the seeds in its options
    pycolmap.set_random_seed(options.seed)
    output.mkdir(parents=True, exist_ok=True)
    model = pycolmap.triangulate_points(
        posed,
        task.database,
        task.images,
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
    seed, threads = {"random_seed": options.seed}, {"num_threads": options.mapper_threads}
    return pycolmap.IncrementalPipelineOptions(
        {
            **seed,
            **threads,
            "mapper": {**seed, **threads},
            "triangulation": {**seed, "ignore_two_view_tracks": not options.two_view_tracks},
            # mapping must not stop at a first model of a few images (see map_images)
            "multiple_models": True,
            "min_model_size": MIN_IMAGES,
        }
    )
