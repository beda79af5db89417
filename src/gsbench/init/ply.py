"""A trained model as the start of another training."""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from gsbench.errors import InputError
from gsbench.init.base import GAUSSIANS_FILE, InitReport, Progress, no_progress
from gsbench.init.relay import run_with_progress
from gsbench.init.timer import Timer
from gsbench.scene.types import Capture


@dataclass(frozen=True, kw_only=True)
class Ply:
    """The Gaussians of a 3DGS PLY file, under the reference cameras; they must lie in the gauge of those.

    The model holds their means and colours as points; the training starts from the Gaussians themselves, kept beside it.
    """

    name: ClassVar[str] = "ply"

    path: str

    def __post_init__(self) -> None:
        if not Path(self.path).expanduser().is_file():
            raise InputError(
                f"init.path={self.path} is no file: name a PLY of Gaussians, such as a trial's point_cloud.ply"
            )

    def content(self) -> str:
        """sha256 of the file: what the result depends on beside the options."""
        return hashlib.sha256(Path(self.path).expanduser().read_bytes()).hexdigest()

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
        """Write model, report and Gaussians; ``work_dir`` is not used. ``InputError`` where there are no cameras."""
        from gsbench.gaussians.ply import read_ply
        from gsbench.gaussians.spherical_harmonics import dc_to_rgb

        if reference is None and self.needs_reference(capture):
            raise InputError(f"init=ply needs cameras and scene {capture.name} came without: make them with init=sfm")
        source = Path(self.path).expanduser()
        gaussians = read_ply(source)
        colors = (dc_to_rgb(gaussians.sh_dc).clamp(0, 1) * 255).round().byte().numpy()  # [N, 3]
        points = gaussians.means.double().numpy()  # [N, 3]
        output_dir.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, output_dir / GAUSSIANS_FILE)
        return run_with_progress(
            _place, (self, capture, output_dir, reference, points, colors), progress, what=self.name
        )


def _place(job: tuple[Ply, Capture, Path, Path | None, np.ndarray, np.ndarray], progress: Progress) -> InitReport:
    import pycolmap

    from gsbench.init import reconstruct, report

    options, capture, output_dir, reference, points, colors = job
    timer = Timer()
    model = reconstruct.load_reference(capture, reference)
    assert model is not None
    with timer.phase("place"):
        model.delete_all_points2D_and_points3D()
        for point, color in zip(points, colors, strict=True):
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
