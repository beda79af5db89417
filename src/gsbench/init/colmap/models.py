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
from gsbench.scene.types import Array, Capture, extent_of_centers


def load_reference(capture: Capture, reference: Path | None) -> pycolmap.Reconstruction | None:
    """The model ``reference``, else the capture's, fitted to the image files; None without both."""
    if reference is not None:
        capture = replace(capture, model=reference)
    return None if capture.model is None else read_reference(capture)


def posed_images(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Image]:
    """The images that have a pose, by name."""
    return {image.name: image for image in model.images.values() if image.has_pose}


def training_centers(model: pycolmap.Reconstruction, capture: Capture) -> Array:
    """The centres [V, 3] of the training images with a pose in the model."""
    images = posed_images(model)
    return np.array(
        [images[name].projection_center() for name in capture.train_names if name in images]
    )


def training_extent(model: pycolmap.Reconstruction, capture: Capture) -> float:
    """3DGS's ``cameras_extent`` of the training images with a pose in the model, else 0."""
    centers = training_centers(model, capture)
    return extent_of_centers(centers) if len(centers) else 0.0


def keep_training_points(
    model: pycolmap.Reconstruction, names: Collection[str], images: Path
) -> TrainingPoints:
    """Keep the points that at least two of the images ``names`` see, with only those observations.

    Positions do not change. Colours are read again, from the photographs in the folder ``images``.
    """
    before = model.num_points3D()
    kept = {image.image_id for name, image in posed_images(model).items() if name in names}
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
