"""Reconstruction from a database of verified matches, points under known cameras, and points that training views saw.

Everything here calls native code that can abort the process: run it isolated.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap

from gsbench.errors import InputError
from gsbench.init.base import TrainingPoints
from gsbench.init.colmap.alignment import Array, Similarity, align_poses
from gsbench.init.colmap.pairs import exhaustive_pairs, sequential_pairs
from gsbench.logs import Progress
from gsbench.scene.colmap import MIN_TRACK, read_reference
from gsbench.scene.types import Capture

if TYPE_CHECKING:
    from gsbench.init.colmap.initializer import ColmapInitializer


def verification_options(options: ColmapInitializer) -> pycolmap.TwoViewGeometryOptions:
    """COLMAP's geometric verification of a pair's matches."""
    found = pycolmap.TwoViewGeometryOptions()
    found.ransac.random_seed = options.seed
    found.min_num_inliers = options.min_inliers
    found.min_inlier_ratio = options.min_inlier_ratio
    return found


def load_reference(capture: Capture, reference: Path | None) -> pycolmap.Reconstruction | None:
    """The reference cameras, scaled to the image files and restricted to the capture's images; None without any."""
    if reference is not None:
        capture = replace(capture, model=reference)
    return None if capture.model is None else read_reference(capture)


def select_pairs(names: Sequence[str], options: ColmapInitializer) -> list[tuple[str, str]]:
    """The pairs of image names to match; all for ``auto`` and ``lowres``, of which features will tell the best."""
    if options.pairs == "sequential":
        pairs = sequential_pairs(len(names), options.overlap)
    else:
        pairs = exhaustive_pairs(len(names))
    return [(names[first], names[second]) for first, second in pairs]


def triangulate(
    database: Path,
    images: Path,
    output: Path,
    reference: pycolmap.Reconstruction,
    names: Collection[str],
    options: ColmapInitializer,
    progress: Progress,
) -> pycolmap.Reconstruction:
    """Points from the verified matches of the images ``names`` under the reference's cameras, which stay to the bit.

    The other images of the database are in the model with their cameras, and see no point.
    """
    progress("triangulate", 0, 1)
    known, others = pycolmap.Reconstruction(), []  # its ids must be the database's
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            known.add_camera_with_trivial_rig(camera)
        for stored in opened.read_all_images():
            pose = reference.find_image_with_name(stored.name).cam_from_world()
            image = pycolmap.Image(name=stored.name, camera_id=stored.camera_id, image_id=stored.image_id)
            if stored.name in names:
                known.add_image_with_trivial_frame(image, pose)
            else:
                others.append((image, pose))
    pycolmap.set_random_seed(options.seed)
    output.mkdir(parents=True, exist_ok=True)
    model = pycolmap.triangulate_points(
        known, database, images, output, clear_points=True, options=pipeline_options(options), refine_intrinsics=False
    )
    progress("triangulate", 1, 1)
    if model.num_points3D() == 0:
        raise InputError(
            "no point could be triangulated under the reference cameras: the matches contradict them (are they the "
            "cameras of these photos?), or the photos have too little texture or overlap"
        )
    for image in model.images.values():  # the solver turns them by a rounding error, on some processors
        image.frame.set_cam_from_world(image.camera_id, reference.find_image_with_name(image.name).cam_from_world())
    for image, pose in others:
        model.add_image_with_trivial_frame(image, pose)
    return model


def poses_by_name(model: pycolmap.Reconstruction) -> dict[str, tuple[Array, Array]]:
    """Camera centre [3] and world-to-camera rotation [3, 3] of each registered image."""
    return {
        image.name: (image.projection_center(), image.cam_from_world().rotation.matrix())
        for image in model.images.values()
        if image.has_pose
    }


def common_poses(
    model: pycolmap.Reconstruction, reference: pycolmap.Reconstruction
) -> tuple[Array, Array, Array, Array]:
    """Centres [N, 3] and rotations [N, 3, 3] of the images placed in both: the model's, then the reference's."""
    ours, theirs = poses_by_name(model), poses_by_name(reference)
    names = sorted(ours.keys() & theirs.keys())
    sides = [
        np.array([poses[name][part] for name in names], dtype=np.float64).reshape(-1, *shape)
        for poses in (ours, theirs)
        for part, shape in ((0, (3,)), (1, (3, 3)))
    ]
    return sides[0], sides[1], sides[2], sides[3]


def similarity_to(model: pycolmap.Reconstruction, reference: pycolmap.Reconstruction) -> Similarity | None:
    """The similarity that takes ``model`` to ``reference``; None where too few cameras are common to tell."""
    try:
        return align_poses(*common_poses(model, reference))
    except ValueError:
        return None


def save_reconstruction(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write cameras, images and points of ``model`` in COLMAP's binary form."""
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)


def apply_similarity(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Transform points and poses of ``model`` in place."""
    model.transform(pycolmap.Sim3d(similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation))


def pipeline_options(options: ColmapInitializer) -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's incremental pipeline by our ``options``; the triangulator reads the same."""
    found = pycolmap.IncrementalPipelineOptions()
    found.num_threads = found.mapper.num_threads = options.mapper_threads
    found.random_seed = found.mapper.random_seed = found.triangulation.random_seed = options.seed
    found.triangulation.ignore_two_view_tracks = not options.two_view_tracks
    found.multiple_models = True  # a stray first model of a few images must not be the last (see map_images)
    found.min_model_size = options.min_model_size
    refined = options.intrinsics == "estimate"
    found.ba_refine_focal_length = found.ba_refine_extra_params = refined
    found.mapper.abs_pose_refine_focal_length = found.mapper.abs_pose_refine_extra_params = refined
    return found


def keep_training_points(model: pycolmap.Reconstruction, names: Collection[str], images: Path) -> TrainingPoints:
    """Leave in ``model`` what at least two of the images ``names`` see, with their observations and colours alone.

    Positions stay where they are; ``images`` is the folder of the photographs.
    """
    before, kept = model.num_points3D(), _ids(model, names)
    for point_id in sorted(model.points3D):
        point = model.points3D[point_id]
        seen = [(e.image_id, e.point2D_idx) for e in point.track.elements if e.image_id in kept]
        elements = [pycolmap.TrackElement(*place) for place in seen]
        left = pycolmap.Point3D(xyz=np.array(point.xyz), error=point.error, track=pycolmap.Track(elements))
        model.delete_point3D(point_id)  # with it goes all that was read from it
        if len({image_id for image_id, _ in seen}) < MIN_TRACK:
            continue
        model.add_point3D_with_id(point_id, left)
        for image_id, index in seen:
            model.images[image_id].set_point3D_for_point2D(index, point_id)
    model.extract_colors_for_all_images(images)
    count = model.num_points3D()
    if count == 0:
        raise InputError(
            "init.points_from=train: no point is left that two training views see; take init.points_from=all, or hold "
            "out fewer views"
        )
    return TrainingPoints("train", count, before, 1 - count / before if before else 0.0)


def _ids(model: pycolmap.Reconstruction, names: Collection[str]) -> set[int]:
    wanted = set(names)
    return {image.image_id for image in model.images.values() if image.has_pose and image.name in wanted}
