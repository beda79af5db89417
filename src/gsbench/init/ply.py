"""A trained model as the start of another training."""

from __future__ import annotations

import hashlib
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from gsbench.errors import InputError
from gsbench.init.base import GAUSSIANS_FILE, InitReport, PointCloud
from gsbench.init.placed import PlacedCloud
from gsbench.logs import Progress, no_progress
from gsbench.scene.types import Capture
from gsbench.settings import AnyPath

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True, kw_only=True)
class Ply(PlacedCloud):
    """The Gaussians of a 3DGS PLY file, under the reference cameras; they must lie in the gauge of those.

    The model holds their means and colours as points; the training starts from the Gaussians themselves, kept beside.
    """

    name: ClassVar[str] = "ply"

    path: AnyPath

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.file.is_file():
            raise InputError(f"init.path={self.path} is no file: name a PLY of Gaussians, as a trial's point_cloud.ply")
        from gsbench.gaussians.ply import check_ply

        check_ply(self.file)

    @property
    def file(self) -> Path:
        return Path(self.path).expanduser()

    def content(self) -> str:
        """sha256 of the file: what the result depends on beside the options."""
        return hashlib.sha256(self.file.read_bytes()).hexdigest()

    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        """Run as `PlacedCloud.run` does, and write the Gaussians to `GAUSSIANS_FILE`."""
        result = super().run(capture, output_dir, progress, reference, work_dir)
        shutil.copyfile(self.file, output_dir / GAUSSIANS_FILE)
        return result

    def cloud(self, capture: Capture, model: pycolmap.Reconstruction) -> PointCloud:
        from gsbench.gaussians.model import dc_to_rgb
        from gsbench.gaussians.ply import read_ply

        gaussians = read_ply(self.file)
        colors = (dc_to_rgb(gaussians.sh_dc).clamp(0, 1) * 255).round().byte().numpy()  # [N, 3]
        return PointCloud(gaussians.means.double().numpy(), colors)
