"""The cloud and the cameras that came with a COLMAP model."""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from gsbench.errors import InputError
from gsbench.init.base import WORK_FOLDER, Initializer, InitReport, PointsFrom, Timer, TrainingPoints
from gsbench.init.colmap.progress_pipe import run_with_progress
from gsbench.logs import Progress, no_progress
from gsbench.scene.types import Capture
from gsbench.settings import check_settings

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class Dataset(Initializer):
    """Takes over the capture's model: restricted to its selected images, cameras scaled to the files.

    ``points_from=train`` leaves what two training views see, where it is, in their colours.
    """

    name: ClassVar[str] = "dataset"

    points_from: PointsFrom = "all"

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
        """Write model and report; the other arguments are not used. ``InputError`` where there is no cloud."""
        if capture.model is None:
            raise InputError(f"init=dataset: scene {capture.name} came without a COLMAP model: use init=sfm")
        output_dir.mkdir(parents=True, exist_ok=True)
        return run_with_progress(_copy_model, (self, capture, output_dir), progress, what=self.name)


def _copy_model(job: tuple[Dataset, Capture, Path], progress: Progress) -> InitReport:
    from gsbench.init import report
    from gsbench.scene.colmap import read_reference

    options, capture, output_dir = job
    timer = Timer()
    with timer.phase("read"):
        model = read_reference(capture)
    if model.num_points3D() == 0:
        raise InputError(f"init=dataset: the model of scene {capture.name} has no points: use init=sfm or init=random")
    points = None
    if options.points_from == "train":
        with timer.phase("train"):
            points = _of_training(capture, model, output_dir / WORK_FOLDER)
    result = report.make_report(
        options.name,
        "shared",
        capture,
        model,
        1.0,
        settings=asdict(options),
        seconds=timer.rounded(),
        packages=("pycolmap",),
        training_points=points,
    )
    report.write_result(model, result, output_dir)
    return result


def _of_training(capture: Capture, model: pycolmap.Reconstruction, work: Path) -> TrainingPoints:
    """Leave in ``model`` the points that training views alone vouch for."""
    from gsbench.init.colmap.database import readable_images
    from gsbench.init.colmap.reconstruct import keep_training_points

    work.mkdir(parents=True, exist_ok=True)
    try:
        return keep_training_points(
            model, capture.train_names, readable_images(capture.images, capture.train_names, work)
        )
    finally:
        shutil.rmtree(work, ignore_errors=True)
