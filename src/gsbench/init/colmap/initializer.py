"""Base of initialisers that end in COLMAP: checks, preparation, and the job in a process of its own."""

from __future__ import annotations

import logging
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from gsbench.errors import InputError
from gsbench.init.base import MIN_IMAGES, WORK_FOLDER, Initializer, InitReport, Preparation
from gsbench.init.colmap.options import ColmapOptions
from gsbench.init.colmap.progress_pipe import run_with_progress
from gsbench.logs import Progress, no_progress
from gsbench.scene.types import Capture
from gsbench.words import counted

logger = logging.getLogger(__name__)

LOG_FILE = "colmap.log"


@dataclass(frozen=True, kw_only=True)
class ColmapInitializer(ColmapOptions, Initializer):
    """Base of `Sfm`, `SfmDense`, `Dim` and `SiftKornia`.

    The reference's cameras are those of the ``reference`` given to `run`, else those that came with the capture.
    """

    is_own_reference: ClassVar[bool] = False  # with poses=shared and no reference: estimate the poses here

    def needs_reference(self, capture: Capture) -> bool:
        """Return whether `run` needs a ``reference`` because the capture came without cameras."""
        shared_without = self.poses == "shared" and not self.is_own_reference
        return capture.model is None and (shared_without or self.intrinsics == "reference")

    def run(
        self,
        capture: Capture,
        output_dir: Path,
        progress: Progress = no_progress,
        reference: Path | None = None,
        work_dir: Path | None = None,
    ) -> InitReport:
        """Write model and report, as `Initializer` says.

        ``work_dir`` keeps features and matches for a later run; without it they are kept within ``output_dir`` until
        the run succeeds, so that a killed run goes on there.

        Raises ``InputError`` where the photos or settings do not give a model.
        """
        self.check(capture, reference)
        output_dir.mkdir(parents=True, exist_ok=True)
        work = output_dir / WORK_FOLDER if work_dir is None else work_dir
        work.mkdir(parents=True, exist_ok=True)
        preparation = self.prepare(capture, work, reference, progress)
        from gsbench.init.colmap.job import Job, build_model

        job = Job(self, capture, output_dir, work, reference, preparation)
        report = run_with_progress(build_model, job, progress, what=self.name, log=output_dir / LOG_FILE)
        if work_dir is None:
            shutil.rmtree(work)
        for warning in report.warnings:
            logger.warning("%s: %s", self.name, warning)
        return report

    def check(self, capture: Capture, reference: Path | None) -> None:
        """Raise ``InputError``, before any work, where this capture cannot be initialised like this."""
        if len(capture.image_names) < MIN_IMAGES:
            raise InputError(
                f"scene {capture.name} has {counted(len(capture.image_names), 'image')}: {self.name} needs at least "
                f"{MIN_IMAGES}"
            )
        if reference is None and self.needs_reference(capture):
            raise InputError(
                f"init={self.name} takes its cameras from a reference, and scene {capture.name} came without: "
                "make one with init=sfm first, or set init.poses=own and init.intrinsics=estimate"
            )

    def prepare(self, capture: Capture, work_dir: Path, reference: Path | None, progress: Progress) -> Preparation:
        """Work to be done before COLMAP starts; none, unless overridden."""
        return Preparation()
