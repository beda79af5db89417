"""An initialiser that only makes points; docs/initialiser.md says how to run it."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import PositiveFloat, PositiveInt

from gsbench.init.base import PointCloud, Seed
from gsbench.init.colmap.models import training_centers
from gsbench.init.placed import PlacedCloud


@dataclass(frozen=True, kw_only=True)
class Shell(PlacedCloud):
    """Grey points on a sphere around the training cameras."""

    name: ClassVar[str] = "shell"  # as reports call it

    count: PositiveInt = 10_000
    radius: PositiveFloat = 2.0  # in distances of the farthest camera from their mean
    seed: Seed = 0

    def cloud(self, capture, model):
        centers = training_centers(model, capture)  # [V, 3], of those that have a pose
        middle = centers.mean(axis=0)
        reach = np.linalg.norm(centers - middle, axis=1).max()
        directions = np.random.default_rng(self.seed).normal(size=(self.count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        points = middle + self.radius * reach * directions  # [P, 3] float64
        return PointCloud(points, np.full((self.count, 3), 128, dtype=np.uint8))
