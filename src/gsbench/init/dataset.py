"""The cloud and the cameras that came with a COLMAP model."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar

from gsbench.errors import InputError
from gsbench.init.base import Initializer, InitReport, Timer
from gsbench.init.colmap.progress_pipe import run_with_progress
from gsbench.logs import Progress, no_progress
from gsbench.scene.types import Capture


@dataclass(frozen=True, kw_only=True)
class Dataset(Initializer):
    """Takes over the capture's model: restricted to its selected images, cameras scaled to the files."""

    name: ClassVar[str] = "dataset"

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
    result = report.make_report(
        options.name,
        "shared",
        capture,
        model,
        1.0,
        settings=asdict(options),
        seconds=timer.rounded(),
        packages=("pycolmap",),
    )
    report.write_result(model, result, output_dir)
    return result
