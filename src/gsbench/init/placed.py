"""Initialisers that keep the reference's cameras and take points from elsewhere.

The points are those of the reference, random, or from a file. A file holds points of any origin
(laser scans, multi-view stereo), or a trained model.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from annotated_types import Interval
from pydantic import PositiveFloat, PositiveInt

from gsbench.errors import InputError
from gsbench.files import file_sha256
from gsbench.init.base import (
    GAUSSIANS_FILE,
    Initializer,
    InitReport,
    PointCloud,
    PointsFrom,
    Seed,
    Timer,
    TrainingPoints,
)
from gsbench.init.point_files import read_points
from gsbench.logs import Progress, no_progress
from gsbench.scene.types import Capture
from gsbench.settings import AnyPath, check_settings
from gsbench.system.isolate import run_isolated

if TYPE_CHECKING:
    import pycolmap


class PlacedCloud(Initializer):
    """Base of initialisers that keep the reference's cameras. Subclasses are dataclasses."""

    def __post_init__(self) -> None:
        check_settings(self, "init")

    def needs_reference(self, capture: Capture) -> bool:
        """Return whether `run` needs a ``reference`` because the capture came without cameras."""
        return capture.model is None

    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        """Write model and report without a ``work_dir``. Raises ``InputError`` without cameras."""
        if reference is None and capture.model is None:
            raise InputError(
                f"init={self.name} needs cameras and scene {capture.name} came without: make them "
                "with init=sfm first"
            )
        output_dir.mkdir(parents=True, exist_ok=True)
        return run_isolated(self.build, capture, output_dir, reference, what=self.name)

    def build(self, capture: Capture, output_dir: Path, reference: Path | None) -> InitReport:
        """Write the model and the report; runs in the isolated process."""
        from gsbench.init.report import make_report, write_result
        from gsbench.scene.colmap import read_reference

        timer = Timer()
        with timer.phase("read"):
            model = read_reference(replace(capture, model=reference or capture.model))
        with timer.phase("place"):
            points = self.set_points(model, capture, output_dir)
        report = make_report(
            self.name,
            "shared",
            capture,
            model,
            scale_to_reference=1.0,
            settings=asdict(self),  # type: ignore[call-overload]
            seconds=timer.rounded(),
            training_points=points,
        )
        write_result(model, report, output_dir)
        return report

    def set_points(
        self, model: pycolmap.Reconstruction, capture: Capture, output_dir: Path
    ) -> TrainingPoints | None:
        """Replace the points of the reference ``model`` by those of `cloud`."""
        replace_points(model, self.cloud(capture, model))
        return None

    def cloud(self, capture: Capture, model: pycolmap.Reconstruction) -> PointCloud:
        """The points for the reference ``model``; runs in the isolated process."""
        raise NotImplementedError


def replace_points(model: pycolmap.Reconstruction, cloud: PointCloud) -> None:
    """Replace all points of ``model`` by those of ``cloud``, which no image observes."""
    import pycolmap

    model.delete_all_points2D_and_points3D()
    for point, color in zip(cloud.points, cloud.colors, strict=True):
        model.add_point3D(point, pycolmap.Track(), color)


@dataclass(frozen=True, kw_only=True)
class Dataset(PlacedCloud):
    """Uses the capture's own model, restricted to the selected images and fitted to their files.

    ``points_from=train`` keeps the points that at least two training views see, in the colours of
    those views.
    """

    name: ClassVar[str] = "dataset"

    # all views | train (points that at least two training views see, in the colours of those:
    # docs/splits.md)
    points_from: PointsFrom = "all"

    def needs_reference(self, capture: Capture) -> bool:
        return False  # it takes the points of the capture's own model, so it cannot do without one

    def set_points(
        self, model: pycolmap.Reconstruction, capture: Capture, output_dir: Path
    ) -> TrainingPoints | None:
        from gsbench.init.colmap.database import readable_images
        from gsbench.init.colmap.models import keep_training_points

        if model.num_points3D() == 0:
            raise InputError(
                f"init=dataset: the model of scene {capture.name} has no points: use init=sfm or "
                "random"
            )
        if self.points_from == "all":
            return None
        with TemporaryDirectory(dir=output_dir) as work:
            images = readable_images(capture.images, capture.train_names, Path(work))
            return keep_training_points(model, capture.train_names, images)


@dataclass(frozen=True, kw_only=True)
class Random(PlacedCloud):
    """Uniform points and colours in a cube around the mean of the reference's training cameras.

    ``size`` is half the cube's edge in scene extents; 3 and 100,000 points are gsplat's defaults
    for a random start.
    """

    name: ClassVar[str] = "random"
    random_points: ClassVar[bool] = True

    # points (gsplat's default for a random start)
    count: Annotated[int, Interval(ge=1, le=10_000_000)] = 100_000
    size: PositiveFloat = 3.0  # half the cube's edge, in scene extents (gsplat's default)
    seed: Seed = 0  # of positions and colours

    def cloud(self, capture: Capture, model: pycolmap.Reconstruction) -> PointCloud:
        from gsbench.init.colmap.models import training_centers, training_extent

        # Equal points would make the search for neighbours before training quadratic.
        extent = training_extent(model, capture)
        if extent == 0:
            raise InputError(
                f"init=random: the training cameras of scene {capture.name} are all at one place"
            )
        generator = np.random.default_rng(self.seed)
        center = training_centers(model, capture).mean(axis=0)
        cube = generator.uniform(-1.0, 1.0, (self.count, 3))
        colors = generator.integers(0, 256, (self.count, 3), dtype=np.uint8)
        return PointCloud(center + self.size * extent * cube, colors)


MAX_LISTED = 3  # models that an error lists
GREY = 128  # of points without a colour


@dataclass(frozen=True, kw_only=True)
class FromFile(PlacedCloud):
    """Base of initialisers that read the file ``path``."""

    path: AnyPath  # the file, for example a trial's point_cloud.ply

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.file.is_file():
            # such as the folder of a trained model: point_cloud/iteration_30000/point_cloud.ply
            models = [str(path) for path in islice(self.file.rglob("*.ply"), MAX_LISTED)]
            hint = f", but a folder: give {' or '.join(models)}" if models else ""
            raise InputError(f"init.path={self.path} is not a file{hint}")

    @property
    def file(self) -> Path:
        return Path(self.path).expanduser()

    def content(self) -> str:
        """The sha256 of the file."""
        return file_sha256(self.file)


@dataclass(frozen=True, kw_only=True)
class Points(FromFile):
    """The points of a file, which must have the coordinates of the reference cameras.

    At most ``max_points`` random points are kept. Without colours in the file, all are grey.
    """

    name: ClassVar[str] = "points"

    max_points: PositiveInt | None = 200_000  # a random choice of at most so many; null: all
    seed: Seed = 0  # of the random choice

    def cloud(self, capture: Capture, model: pycolmap.Reconstruction) -> PointCloud:
        points, colors = read_points(self.file)
        order = np.random.default_rng(self.seed).permutation(len(points))
        chosen = np.sort(order[: self.max_points])
        points = capture.normalization.apply(points)[chosen]
        if colors is None:
            return PointCloud(points, np.full(points.shape, GREY, np.uint8))
        return PointCloud(points, colors[chosen])


@dataclass(frozen=True, kw_only=True)
class Ply(FromFile):
    """The Gaussians of a 3DGS PLY file, which must have the coordinates of the reference cameras.

    The model holds their means and colours as points. Training starts from the Gaussians in
    `GAUSSIANS_FILE`.
    """

    name: ClassVar[str] = "ply"

    def __post_init__(self) -> None:
        super().__post_init__()
        from gsbench.gaussians.ply import check_ply

        check_ply(self.file)

    def set_points(
        self, model: pycolmap.Reconstruction, capture: Capture, output_dir: Path
    ) -> TrainingPoints | None:
        from gsbench.gaussians.model import dc_to_bytes
        from gsbench.gaussians.ply import read_ply, write_ply

        gaussians = read_ply(self.file, normalization=capture.normalization)
        write_ply(gaussians, output_dir / GAUSSIANS_FILE)
        cloud = PointCloud(gaussians.means.double().numpy(), dc_to_bytes(gaussians.sh_dc))
        replace_points(model, cloud)
        return None
