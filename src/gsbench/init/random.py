"""Points drawn at random in a box around the cameras: the weakest start there is."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from gsbench.errors import InputError
from gsbench.init.base import InitReport, PointCloud, Progress, no_progress
from gsbench.init.checks import check_integer, check_number
from gsbench.init.relay import run_with_progress
from gsbench.init.timer import Timer
from gsbench.scene.types import Capture


@dataclass(frozen=True, kw_only=True)
class Random:
    """Uniform points and colours in a cube around the mean of the training cameras, under the reference cameras.

    ``size`` is half the cube's edge in scene extents; 3 and 100,000 points are gsplat's defaults for a random start.
    """

    name: ClassVar[str] = "random"

    count: int = 100_000
    size: float = 3.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_integer("count", self.count, 1, 10_000_000)
        check_number("size", self.size, 0, exclusive=True)
        check_integer("seed", self.seed, 0, 2**31 - 1)

    def needs_reference(self, capture: Capture) -> bool:
        """Whether `run` needs a ``reference`` because the capture came without cameras."""
        return capture.model is None

    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        """Write model and report; ``work_dir`` is not used. ``InputError`` where there are no cameras."""
        if reference is None and self.needs_reference(capture):
            raise InputError(
                f"init=random needs cameras and scene {capture.name} came without: make a reference with init=sfm first"
            )
        output_dir.mkdir(parents=True, exist_ok=True)
        return run_with_progress(_scatter, (self, capture, output_dir, reference), progress, what=self.name)


def random_cloud(center: np.ndarray, half_edge: float, count: int, seed: int) -> PointCloud:
    """``count`` points uniform in the cube of edge ``2 * half_edge`` around ``center`` [3], with uniform colours."""
    generator = np.random.default_rng(seed)
    points = center + half_edge * generator.uniform(-1.0, 1.0, (count, 3))
    return PointCloud(points, generator.integers(0, 256, (count, 3), dtype=np.uint8))


def _scatter(job: tuple[Random, Capture, Path, Path | None], progress: Progress) -> InitReport:
    import pycolmap

    from gsbench.init import reconstruct, report

    options, capture, output_dir, reference = job
    timer = Timer()
    model = reconstruct.load_reference(capture, reference)
    assert model is not None
    with timer.phase("draw"):
        model.delete_all_points2D_and_points3D()
        poses = reconstruct.poses_by_name(model)
        centers = [poses[name][0] for name in capture.train_names if name in poses]
        extent = report.training_extent(model, capture)
        if extent == 0:
            raise InputError(f"init=random: the training cameras of scene {capture.name} stand all at one place")
        cloud = random_cloud(np.mean(centers, axis=0), options.size * extent, options.count, options.seed)
        for point, color in zip(cloud.points, cloud.colors, strict=True):
            model.add_point3D(point, pycolmap.Track(), color)
    result = report.make_report(
        options.name,
        "shared",
        capture,
        model,
        1.0,
        settings=asdict(options),
        seconds=timer.rounded(),
        packages=("pycolmap", "numpy"),
    )
    report.write_result(model, result, output_dir)
    return result
