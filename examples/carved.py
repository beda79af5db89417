r"""Random initial points without those that no training camera sees; an idea of Faster-GS.

    gsbench init=random init._target_=carved.Carved init.name=carved +init.seen_by=1 \
        allow_targets=[carved]
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import PositiveInt

from gsbench.errors import InputError
from gsbench.init import Random
from gsbench.init.base import PointCloud


@dataclass(frozen=True, kw_only=True)
class Carved(Random):
    """`Random` without the points that fewer than ``seen_by`` training cameras have in view."""

    name: ClassVar[str] = "carved"

    seen_by: PositiveInt = 1

    def cloud(self, capture, model):
        cloud = super().cloud(capture, model)
        cameras = np.zeros(self.count, dtype=np.int64)  # [P] that have each point in view
        for name in capture.train_names:
            cameras[in_view(cloud.points, name, model)] += 1
        kept = cameras >= self.seen_by
        if not kept.any():
            raise InputError(
                f"init=carved: none of {self.count} points is in view of {self.seen_by} training "
                "cameras: take a smaller init.size"
            )
        return PointCloud(cloud.points[kept], cloud.colors[kept])


def in_view(points, name, model):
    """The indices of the ``points`` [P, 3] in view of the image ``name``; occlusion is ignored."""
    image = model.find_image_with_name(name)
    if image is None or not image.has_pose:
        return np.empty(0, np.int64)
    camera = model.cameras[image.camera_id]
    pixels = np.asarray(camera.img_from_cam(image.cam_from_world() * points))  # NaN behind it
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0) & (pixels < (camera.width, camera.height))
    return np.nonzero(inside.all(axis=1))[0]
