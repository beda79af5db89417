"""Base of initialisers that put points of their own under reference cameras."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbench.errors import InputError
from gsbench.init.base import Initializer, InitReport, PointCloud, Timer
from gsbench.init.colmap.progress_pipe import run_with_progress
from gsbench.logs import Progress, no_progress
from gsbench.scene.types import Capture
from gsbench.settings import check_settings

if TYPE_CHECKING:
    import pycolmap


class PlacedCloud(Initializer):
    """Base of `Random` and `Ply`: the reference's cameras, and a cloud that the subclass, a dataclass, makes."""

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
        """Write model and report; ``work_dir`` is not used. ``InputError`` where there are no cameras."""
        if reference is None and self.needs_reference(capture):
            raise InputError(
                f"init={self.name} needs cameras and scene {capture.name} came without: make them with init=sfm first"
            )
        output_dir.mkdir(parents=True, exist_ok=True)
        return run_with_progress(_place, (self, capture, output_dir, reference), progress, what=self.name)

    @abstractmethod
    def cloud(self, capture: Capture, model: pycolmap.Reconstruction) -> PointCloud:
        """The points, given the reference ``model``; runs in the isolated process."""


def _place(job: tuple[PlacedCloud, Capture, Path, Path | None], progress: Progress) -> InitReport:
    import pycolmap

    from gsbench.init import report
    from gsbench.init.colmap import reconstruct

    initializer, capture, output_dir, reference = job
    timer = Timer()
    model = reconstruct.load_reference(capture, reference)
    assert model is not None
    with timer.phase("place"):
        cloud = initializer.cloud(capture, model)
        model.delete_all_points2D_and_points3D()
        for point, color in zip(cloud.points, cloud.colors, strict=True):
            model.add_point3D(point, pycolmap.Track(), color)
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
    )
    report.write_result(model, result, output_dir)
    return result
