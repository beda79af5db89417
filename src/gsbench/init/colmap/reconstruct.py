"""Triangulation under reference cameras, options of COLMAP's pipelines, and operations on COLMAP
models.

Everything here calls native code that can abort the process: run it isolated.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from gsbench.errors import InputError
from gsbench.init.base import TrainingPoints
from gsbench.init.colmap.alignment import Similarity, align_poses
from gsbench.init.colmap.pairs import sequential_pairs
from gsbench.logs import Progress
from gsbench.scene.colmap import MIN_TRACK, read_reference
from gsbench.scene.types import Array, Capture

if TYPE_CHECKING:
    from gsbench.init.sfm import ColmapInitializer


def verification_options(options: ColmapInitializer) -> pycolmap.TwoViewGeometryOptions:
    """The options of COLMAP's geometric verification of a pair."""
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.seed
    verification.min_num_inliers = options.min_inliers
    verification.min_inlier_ratio = options.min_inlier_ratio
    return verification


def load_reference(capture: Capture, reference: Path | None) -> pycolmap.Reconstruction | None:
    """The reference model, scaled to the image files and restricted to the capture's images; None
    if there is none."""
    if reference is not None:
        capture = replace(capture, model=reference)
    return None if capture.model is None else read_reference(capture)


def select_pairs(names: Sequence[str], options: ColmapInitializer) -> list[tuple[str, str]]:
    """The pairs of image names to match; for ``auto`` and ``lowres`` all pairs, from which features
    select later."""
    if options.pairs == "sequential":
        return [
            (names[first], names[second])
            for first, second in sequential_pairs(len(names), options.overlap)
        ]
    return list(combinations(names, 2))


def triangulate(
    database: Path,
    images: Path,
    output: Path,
    reference: pycolmap.Reconstruction,
    names: Collection[str],
    options: ColmapInitializer,
    progress: Progress,
) -> pycolmap.Reconstruction:
    """Triangulate the verified matches of the images ``names`` under the reference's cameras, which
    do not change.

    The other images of the database are in the model with their cameras, but see no point.
    """
    progress("triangulate", 0, 1)
    posed, unused = pycolmap.Reconstruction(), []  # with the ids of the database
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
            "them (are they the "
            "cameras of these photos?), or the photos have too little texture or overlap"
        )
    # On some processors the solver changes the fixed poses by a rounding error.
    for image in model.images.values():
        image.frame.set_cam_from_world(
            image.camera_id, reference.find_image_with_name(image.name).cam_from_world()
        )
    for image, pose in unused:
        model.add_image_with_trivial_frame(image, pose)
    return model


def poses_by_name(model: pycolmap.Reconstruction) -> dict[str, tuple[Array, Array]]:
    """The camera centre [3] and world-to-camera rotation [3, 3] of each registered image."""
    return {
        image.name: (image.projection_center(), image.cam_from_world().rotation.matrix())
        for image in model.images.values()
        if image.has_pose
    }


def common_poses(
    model: pycolmap.Reconstruction, reference: pycolmap.Reconstruction
) -> tuple[Array, Array, Array, Array]:
    """Centres [N, 3] and rotations [N, 3, 3] of the model, then of the reference, for images with a
    pose in both."""
    model_poses, reference_poses = poses_by_name(model), poses_by_name(reference)
    names = sorted(model_poses.keys() & reference_poses.keys())
    poses = [source[name] for source in (model_poses, reference_poses) for name in names]
    centers = np.array([center for center, _ in poses]).reshape(2, -1, 3)
    rotations = np.array([rotation for _, rotation in poses]).reshape(2, -1, 3, 3)
    return centers[0], rotations[0], centers[1], rotations[1]


def similarity_to(
    model: pycolmap.Reconstruction, reference: pycolmap.Reconstruction
) -> Similarity | None:
    """The similarity from ``model`` to ``reference``, or None if they have too few cameras in
    common."""
    try:
        return align_poses(*common_poses(model, reference))
    except ValueError:
        return None


def save_reconstruction(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write ``model`` in COLMAP's binary format."""
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)


def pipeline_options(options: ColmapInitializer) -> pycolmap.IncrementalPipelineOptions:
    """The options of COLMAP's incremental mapper, which its triangulator reads too."""
    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.num_threads = pipeline.mapper.num_threads = options.mapper_threads
    pipeline.random_seed = pipeline.mapper.random_seed = pipeline.triangulation.random_seed = (
        options.seed
    )
    pipeline.triangulation.ignore_two_view_tracks = not options.two_view_tracks
    # mapping must not stop at a first model of a few images (see map_images)
    pipeline.multiple_models = True
    pipeline.min_model_size = options.min_model_size
    refine = options.intrinsics == "estimate"
    pipeline.ba_refine_focal_length = pipeline.ba_refine_extra_params = refine
    pipeline.mapper.abs_pose_refine_focal_length = pipeline.mapper.abs_pose_refine_extra_params = (
        refine
    )
    return pipeline


def keep_training_points(
    model: pycolmap.Reconstruction, names: Collection[str], images: Path
) -> TrainingPoints:
    """Keep the points of ``model`` that at least two of the images ``names`` see, with those
    observations alone.

    Positions do not change. Colours are read again, from the photographs in the folder ``images``.
    """
    before = model.num_points3D()
    kept = {
        image.image_id for image in model.images.values() if image.has_pose and image.name in names
    }
    for point_id in sorted(model.points3D):
        point = model.points3D[point_id]
        observations = [
            (element.image_id, element.point2D_idx)
            for element in point.track.elements
            if element.image_id in kept
        ]
        track = pycolmap.Track(
            [pycolmap.TrackElement(*observation) for observation in observations]
        )
        copy = pycolmap.Point3D(xyz=np.array(point.xyz), error=point.error, track=track)
        model.delete_point3D(point_id)  # `point` is a view into the model, and invalid from here on
        if len({image_id for image_id, _ in observations}) < MIN_TRACK:
            continue
        model.add_point3D_with_id(point_id, copy)
        for image_id, index in observations:
            model.images[image_id].set_point3D_for_point2D(index, point_id)
    model.extract_colors_for_all_images(images)
    count = model.num_points3D()
    if count == 0:
        raise InputError(
            "init.points_from=train: no point is left that two training views see; take "
            "init.points_from=all, or hold "
            "out fewer views"
        )
    return TrainingPoints("train", count, before, 1 - count / before if before else 0.0)
