r"""Structure from motion with shifted copies of each point (LichtFeld-Studio's pull request 411).

    gsbench init=sfm init._target_=jittered.Jittered init.name=jittered +init.shift=0.5 \
        allow_targets=[jittered]
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pycolmap
from pydantic import PositiveFloat
from scipy.spatial import cKDTree

from gsbench.init import MODEL_FOLDER, Sfm
from gsbench.logs import no_progress
from gsbench.scene.colmap import model_points, read_model, save_model


@dataclass(frozen=True, kw_only=True)
class Jittered(Sfm):
    """`Sfm` with one more point near each, in its colour.

    The shift is normal with standard deviation ``shift`` times the distance to the point's nearest
    neighbour.
    """

    name: ClassVar[str] = "jittered"
    is_own_reference: ClassVar[bool] = False

    shift: PositiveFloat = 0.5

    def run(self, capture, output_dir, progress=no_progress, reference=None, work_dir=None):
        report = super().run(capture, output_dir, progress, reference, work_dir)
        model = read_model(output_dir / MODEL_FOLDER)
        points, colors = model_points(model)
        distances, _ = cKDTree(points).query(points, k=2)  # [P, 2]: the first is the point itself
        noise = np.random.default_rng(self.seed).standard_normal(points.shape)
        for place, color in zip(
            points + self.shift * distances[:, 1:] * noise, colors, strict=True
        ):
            model.add_point3D(place, pycolmap.Track(), color)
        save_model(model, output_dir / MODEL_FOLDER)
        return report
