"""Structure from motion whose points are doubled: a denser start from the same photographs, without weights."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import PositiveFloat, PositiveInt
from scipy.spatial import cKDTree

from gsbench.init.base import MODEL_FOLDER, InitReport
from gsbench.init.colmap.alignment import Array
from gsbench.init.colmap.progress_pipe import run_with_progress
from gsbench.init.sfm import Sfm
from gsbench.logs import Progress, no_progress
from gsbench.scene.types import Capture


@dataclass(frozen=True, kw_only=True)
class Jittered(Sfm):
    """`Sfm`, then ``copies`` more of each point, of its colour, shifted at random.

    A shift is normal with standard deviation ``shift`` times the distance to the point's nearest neighbour. The copies
    have no tracks, so errors and track lengths of the report are those of the points themselves.
    """

    name: ClassVar[str] = "jittered"
    is_own_reference: ClassVar[bool] = False

    copies: PositiveInt = 1
    shift: PositiveFloat = 0.5

    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        """Run as `Sfm` does, with the copies in the model and counted in the report."""
        report = super().run(capture, output_dir, progress, reference, work_dir)
        return run_with_progress(_add_copies, (self, report, output_dir), progress, what=self.name)


def _add_copies(job: tuple[Jittered, InitReport, Path], progress: Progress) -> InitReport:
    import pycolmap

    from gsbench.init.report import write_result

    options, report, output_dir = job
    model = pycolmap.Reconstruction(output_dir / MODEL_FOLDER)
    points = [model.points3D[index] for index in sorted(model.points3D)]
    colors = np.array([point.color for point in points])  # [P, 3]
    copies = shifted_copies(np.array([point.xyz for point in points]), options.copies, options.shift, options.seed)
    for index, place in enumerate(copies):
        model.add_point3D(place, pycolmap.Track(), colors[index % len(colors)])
    counts = {**report.counts, "shifted_copies": len(copies)}
    result = replace(report, num_points=model.num_points3D(), counts=counts)
    write_result(model, result, output_dir)
    return result


def shifted_copies(points: Array, copies: int, shift: float, seed: int) -> Array:
    """``copies`` times all of ``points`` [P, 3], one after another, each shifted within its neighbourhood: [copies P,
    3]."""
    distances, _ = cKDTree(points).query(points, k=2)  # [P, 2], the first is the point itself
    spread = shift * distances[:, 1:]  # [P, 1] world units
    noise = np.random.default_rng(seed).standard_normal((copies, len(points), 3))
    return (points + spread * noise).reshape(-1, 3)
