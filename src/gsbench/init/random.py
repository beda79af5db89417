"""Points drawn at random in a box around the cameras: the weakest start there is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from annotated_types import Interval
from pydantic import PositiveFloat, PositiveInt

from gsbench.errors import InputError
from gsbench.init.base import PointCloud, Seed
from gsbench.init.placed import PlacedCloud
from gsbench.scene.types import Capture

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class Random(PlacedCloud):
    """Uniform points and colours in a cube around the mean of the training cameras, under the reference cameras.

    ``size`` is half the cube's edge in scene extents; 3 and 100,000 points are gsplat's defaults for a random start.
    """

    name: ClassVar[str] = "random"

    count: Annotated[int, Interval(ge=1, le=10_000_000)] = 100_000
    size: PositiveFloat = 3.0
    seed: Seed = 0

    def cloud(self, capture: Capture, model: pycolmap.Reconstruction) -> PointCloud:
        from gsbench.init import report
        from gsbench.init.colmap import reconstruct

        poses = reconstruct.poses_by_name(model)
        centers = [poses[name][0] for name in capture.train_names if name in poses]
        extent = report.training_extent(model, capture)
        if extent == 0:
            raise InputError(f"init=random: the training cameras of scene {capture.name} stand all at one place")
        return random_cloud(np.mean(centers, axis=0), self.size * extent, self.count, self.seed)


@dataclass(frozen=True, kw_only=True)
class Carved(Random):
    """`Random` without the points that fewer than ``seen_by`` training cameras have in view.

    ``count`` are drawn, so fewer remain. The idea is that of Faster-GS: what nobody sees costs, and trains nothing.
    """

    name: ClassVar[str] = "carved"

    seen_by: PositiveInt = 1

    def cloud(self, capture: Capture, model: pycolmap.Reconstruction) -> PointCloud:
        from gsbench.init.points import in_view

        whole = super().cloud(capture, model)
        cameras = np.zeros(self.count, dtype=np.int64)  # that see a point
        for name in capture.train_names:
            cameras[in_view(whole.points, name, model)[0]] += 1
        kept = cameras >= self.seen_by
        if not kept.any():
            raise InputError(
                f"init=carved: of {self.count} points none is in view of {self.seen_by} training cameras of scene "
                f"{capture.name}; take more (init.count), a smaller box (init.size) or fewer cameras (init.seen_by)"
            )
        return PointCloud(whole.points[kept], whole.colors[kept])


def random_cloud(center: np.ndarray, half_edge: float, count: int, seed: int) -> PointCloud:
    """``count`` points uniform in the cube of edge ``2 * half_edge`` around ``center`` [3], with uniform colours."""
    generator = np.random.default_rng(seed)
    points = center + half_edge * generator.uniform(-1.0, 1.0, (count, 3))
    return PointCloud(points, generator.integers(0, 256, (count, 3), dtype=np.uint8))
