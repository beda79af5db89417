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
from gsbench.init.placed import points_in_view


@dataclass(frozen=True, kw_only=True)
class Carved(Random):
    """`Random` without the points that fewer than ``seen_by`` training cameras have in view."""

    name: ClassVar[str] = "carved"

    seen_by: PositiveInt = 1

    def cloud(self, capture, model):
        cloud = super().cloud(capture, model)
        cameras = np.zeros(self.count, dtype=np.int64)  # [P] that have each point in view
        for name in capture.train_names:
            cameras[points_in_view(cloud.points, name, model)[0]] += 1
        kept = cameras >= self.seen_by
        if not kept.any():
            raise InputError(
                f"init=carved: none of {self.count} points is in view of {self.seen_by} training "
                "cameras: take a smaller init.size"
            )
        return PointCloud(cloud.points[kept], cloud.colors[kept])
