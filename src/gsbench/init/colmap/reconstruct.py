"""Operations on COLMAP models. They call native code that can abort: run them isolated."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from gsbench.errors import InputError
from gsbench.init.base import TrainingPoints
from gsbench.scene.colmap import MIN_TRACK, read_reference
from gsbench.scene.types import Array, Capture


def load_reference(capture: Capture, reference: Path | None) -> pycolmap.Reconstruction | None:
    """The model ``reference``, else the capture's, fitted to the image files; None without both."""
    if reference is not None:
        capture = replace(capture, model=reference)
    return None if capture.model is None else read_reference(capture)


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
    """Centres [N, 3] and rotations [N, 3, 3] of model, then reference, for images posed in both."""
    both = poses_by_name(model), poses_by_name(reference)
    names = sorted(both[0].keys() & both[1].keys())
    # the shapes hold without a common image, too
    centers, rotations = (
        [np.array([poses[name][part] for name in names]).reshape(shape) for poses in both]
        for part, shape in enumerate([(-1, 3), (-1, 3, 3)])
    )
    return centers[0], rotations[0], centers[1], rotations[1]


def keep_training_points(
    model: pycolmap.Reconstruction, names: Collection[str], images: Path
) -> TrainingPoints:
    """Keep the points that at least two of the images ``names`` see, with only those observations.

    Positions do not change. Colours are read again, from the photographs in the folder ``images``.
    """
    before = model.num_points3D()
    kept = {
        image.image_id for image in model.images.values() if image.has_pose and image.name in names
    }
    for point_id in sorted(model.points3D):
        point = model.points3D[point_id]
        seen = [element for element in point.track.elements if element.image_id in kept]
        observations = [(element.image_id, element.point2D_idx) for element in seen]
        track = pycolmap.Track(
            [pycolmap.TrackElement(*observation) for observation in observations]
        )
        copy = pycolmap.Point3D(xyz=np.array(point.xyz), error=point.error, track=track)
        # `point` and `seen` are views into the model, and invalid from here on
        model.delete_point3D(point_id)
        if len(dict(observations)) < MIN_TRACK:  # an image may see a point twice
            continue
        model.add_point3D_with_id(point_id, copy)
        for image_id, index in observations:
            model.images[image_id].set_point3D_for_point2D(index, point_id)
    model.extract_colors_for_all_images(images)
    count = model.num_points3D()
    if count == 0:
        raise InputError(
            "init.points_from=train: no point is left that two training views see; take "
            "init.points_from=all, or hold out fewer views"
        )
    return TrainingPoints("train", count, before, 1 - count / before if before else 0.0)
