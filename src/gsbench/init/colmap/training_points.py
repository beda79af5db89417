"""Points that owe nothing to test photographs: what training views saw. Cameras stay as they are.

Everything here calls native code that can abort the process: run it isolated.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
import pycolmap

from gsbench.errors import InputError
from gsbench.init.base import TrainingPoints
from gsbench.scene.colmap import MIN_TRACK


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
