"""Initialisers that keep the reference cameras: with the points of the data set, or with random points."""

from __future__ import annotations

import shutil
from abc import abstractmethod
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray
from pydantic import PositiveFloat, PositiveInt

from gsbench.errors import InputError
from gsbench.init.base import WORK_FOLDER, Initializer, InitReport, PointCloud, PointsFrom, Seed, Timer, TrainingPoints
from gsbench.init.colmap.alignment import Array
from gsbench.logs import Progress, no_progress
from gsbench.scene.types import Capture
from gsbench.settings import check_settings
from gsbench.system.isolate import run_with_progress

if TYPE_CHECKING:
    import pycolmap


class GivenCameras(Initializer):
    """Base of initialisers that keep the reference's cameras and only make points. Subclasses are dataclasses."""

    def __post_init__(self) -> None:
        check_settings(self, "init")

    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        """Write model and report; ``work_dir`` is not used. Raises ``InputError`` if there are no cameras."""
        if reference is None and capture.model is None:
            raise InputError(
                f"init={self.name} needs cameras and scene {capture.name} came without: make them with init=sfm first"
            )
        output_dir.mkdir(parents=True, exist_ok=True)
        return run_with_progress(_build, (self, capture, output_dir, reference), progress, what=self.name)

    @abstractmethod
    def set_points(self, model: pycolmap.Reconstruction, capture: Capture, work: Path) -> TrainingPoints | None:
        """Set the points of the reference ``model``; runs in the isolated process. ``work`` is a temporary folder."""


def _build(job: tuple[GivenCameras, Capture, Path, Path | None], progress: Progress) -> InitReport:
    from gsbench.init import report
    from gsbench.init.colmap.reconstruct import load_reference

    initializer, capture, output_dir, reference = job
    timer = Timer()
    with timer.phase("read"):
        model = load_reference(capture, reference)
    assert model is not None
    with timer.phase("place"):
        training_points = initializer.set_points(model, capture, output_dir / WORK_FOLDER)
    settings: dict[str, Any] = asdict(initializer)  # type: ignore[call-overload]
    result = report.make_report(
        initializer.name,
        "shared",
        capture,
        model,
        1.0,
        settings=settings,
        seconds=timer.rounded(),
        packages=("pycolmap", "numpy"),
        training_points=training_points,
    )
    report.write_result(model, result, output_dir)
    return result


@dataclass(frozen=True, kw_only=True)
class Dataset(GivenCameras):
    """Uses the capture's own model, restricted to the selected images, with cameras scaled to the files.

    ``points_from=train`` keeps the points that at least two training views see, in the colours of those views.
    """

    name: ClassVar[str] = "dataset"

    points_from: PointsFrom = "all"

    def set_points(self, model: pycolmap.Reconstruction, capture: Capture, work: Path) -> TrainingPoints | None:
        from gsbench.init.colmap.database import readable_images
        from gsbench.init.colmap.reconstruct import keep_training_points

        if model.num_points3D() == 0:
            raise InputError(f"init=dataset: the model of scene {capture.name} has no points: use init=sfm or random")
        if self.points_from == "all":
            return None
        work.mkdir(parents=True, exist_ok=True)
        try:
            images = readable_images(capture.images, capture.train_names, work)
            return keep_training_points(model, capture.train_names, images)
        finally:
            shutil.rmtree(work, ignore_errors=True)


class PlacedCloud(GivenCameras):
    """Base of initialisers that put a new cloud under the reference's cameras. Subclasses are dataclasses."""

    def needs_reference(self, capture: Capture) -> bool:
        """Return whether `run` needs a ``reference`` because the capture came without cameras."""
        return capture.model is None

    def set_points(self, model: pycolmap.Reconstruction, capture: Capture, work: Path) -> TrainingPoints | None:
        import pycolmap

        cloud = self.cloud(capture, model)
        model.delete_all_points2D_and_points3D()
        for point, color in zip(cloud.points, cloud.colors, strict=True):
            model.add_point3D(point, pycolmap.Track(), color)
        return None

    @abstractmethod
    def cloud(self, capture: Capture, model: pycolmap.Reconstruction) -> PointCloud:
        """The points for the reference ``model``; runs in the isolated process."""


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
            raise InputError(f"init=random: the training cameras of scene {capture.name} are all at one place")
        return random_cloud(np.mean(centers, axis=0), self.size * extent, self.count, self.seed)


@dataclass(frozen=True, kw_only=True)
class Carved(Random):
    """`Random` without the points that fewer than ``seen_by`` training cameras have in view.

    ``count`` points are drawn, so fewer remain. The idea is from Faster-GS: points that no camera sees cost time and
    train nothing.
    """

    name: ClassVar[str] = "carved"

    seen_by: PositiveInt = 1

    def cloud(self, capture: Capture, model: pycolmap.Reconstruction) -> PointCloud:
        cloud = super().cloud(capture, model)
        num_cameras = np.zeros(self.count, dtype=np.int64)  # [P] that have a point in view
        for name in capture.train_names:
            num_cameras[points_in_view(cloud.points, name, model)[0]] += 1
        kept = num_cameras >= self.seen_by
        if not kept.any():
            raise InputError(
                f"init=carved: of {self.count} points none is in view of {self.seen_by} training cameras of scene "
                f"{capture.name}; take more (init.count), a smaller box (init.size) or fewer cameras (init.seen_by)"
            )
        return PointCloud(cloud.points[kept], cloud.colors[kept])


def random_cloud(center: np.ndarray, half_edge: float, count: int, seed: int) -> PointCloud:
    """``count`` points uniform in the cube of edge ``2 * half_edge`` around ``center`` [3], with uniform colours."""
    generator = np.random.default_rng(seed)
    points = center + half_edge * generator.uniform(-1.0, 1.0, (count, 3))
    return PointCloud(points, generator.integers(0, 256, (count, 3), dtype=np.uint8))


def points_in_view(points: Array, name: str, model: pycolmap.Reconstruction) -> tuple[NDArray[np.int64], Array, Array]:
    """Indices [V], pixels [V, 2] and distances [V] of the ``points`` [P, 3] that project into the image ``name``.

    All three are empty if the image has no pose in the model. Occlusion is ignored.
    """
    image = model.find_image_with_name(name)
    if image is None or not image.has_pose:
        return np.empty(0, np.int64), np.empty((0, 2)), np.empty(0)
    pose, camera = image.cam_from_world(), model.cameras[image.camera_id]
    local = points @ pose.rotation.matrix().T + pose.translation  # [P, 3]
    (ahead,) = np.nonzero(local[:, 2] > 0)
    pixels = np.asarray(camera.img_from_cam(local[ahead])).reshape(-1, 2)  # [A, 2]
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)  # NaN is outside
    seen = ahead[inside]
    return seen, pixels[inside], np.linalg.norm(local[seen], axis=1)
