"""Operations on COLMAP models. They call native code that can abort: run them isolated."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
import pycolmap

from gsbench.errors import InputError
from gsbench.init.base import TrainingPoints
from gsbench.scene.colmap import MIN_TRACK
from gsbench.scene.types import Array, Capture, extent_of_centers


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
    for name, image in posed_images(model).items():
        for index, seen in enumerate(image.points2D):
            if name not in names and seen.has_point3D():
                model.delete_observation(image.image_id, index)  # and its point, if one is left
    for point_id, point in list(model.points3D.items()):
        # an image may see a point twice
        if len({element.image_id for element in point.track.elements}) < MIN_TRACK:
            model.delete_point3D(point_id)
    model.extract_colors_for_all_images(images)
    count = model.num_points3D()
    if count == 0:
        raise InputError(
            "init.points_from=train: no point is left that two training views see; take "
            "init.points_from=all, or hold out fewer views"
        )
    return TrainingPoints("train", count, before, 1 - count / before if before else 0.0)
