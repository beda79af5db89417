"""A trial as TensorBoard event files, in ``tensorboard/`` of the runs folder."""

import shutil
import time
from collections.abc import Sequence
from typing import Any

from gsbench.files import require_no_links
from gsbench.runs.layout import TENSORBOARD
from gsbench.tracking.trial import Scalar, Summary, TrackedTrial


class TensorBoardSink:
    """The event files of one trial. They cannot be edited, so a continued trial is written anew."""

    state_file = "tensorboard.json"

    def __init__(self, trial: TrackedTrial) -> None:
        self._trial = trial
        self._folder = trial.folder.runs / TENSORBOARD / trial.path
        self._started = time.time()
        self._writer: Any = None

    def open(self, state: dict[str, Any], results: str | None) -> dict[str, Any]:
        """Open the run as `gsbench.tracking.trial.Sink` says."""
        if self._folder.is_dir() and state.get("complete") is not None and state["complete"] == results:
            return state
        from torch.utils.tensorboard import SummaryWriter

        require_no_links(self._trial.folder.runs, self._folder)
        shutil.rmtree(self._folder, ignore_errors=True)
        self._writer = SummaryWriter(str(self._folder))
        for name, values in (("settings", self._trial.params()), ("trial", self._trial.tags())):
            table = "".join(f"| {key} | {value} |\n" for key, value in values.items())
            self._writer.add_text(name, f"| | |\n|---|---|\n{table}")
        return {"complete": None, "logged": {}}

    def log(self, scalars: Sequence[Scalar]) -> None:
        """Write numbers, and flush them to the file."""
        for scalar in scalars:
            self._writer.add_scalar(scalar.key, scalar.value, scalar.step, self._started + scalar.seconds)
        self._writer.flush()

    def complete(self, summary: Summary) -> None:
        """Write the final numbers and the pictures of the test views."""
        import numpy as np
        from PIL import Image

        self.log(summary.scalars)
        for name, path in summary.pictures.items():
            with Image.open(path) as image:
                self._writer.add_image(name, np.asarray(image.convert("RGB")), summary.step, dataformats="HWC")
        self._writer.add_text("status", "FINISHED", summary.step)
        self._writer.flush()

    def stop(self, status: str, reason: str | None) -> None:
        """Write why the trial ended."""
        self._writer.add_text("status", status if reason is None else f"{status}: {reason}")
        self._writer.flush()
