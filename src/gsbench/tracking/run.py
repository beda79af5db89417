"""The run of a trial in a tracker: what is missing there is sent, and how far that has come stands in a file."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

from gsbench.files import write_json
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import hold
from gsbench.tracking.sink import DEFAULT, Sink
from gsbench.tracking.trial import TrackedTrial, read_state

LOCK = ".mlflow.lock"  # one process at a time mirrors a trial, to whichever tracker


class TrackerRun:
    """The run of the trial in ``folder``, opened anew or gone on with, and locked until it is closed.

    ``program`` is what runs the trial at this moment; None where the trial has ended. Raises BusyError where another
    process mirrors the trial, and whatever the tracker raises. With ``anew``, the run that was there is deleted.
    """

    def __init__(
        self,
        options: dict[str, Any],
        folder: TrialFolder,
        values: dict[str, Any],
        program: str | None = None,
        anew: bool = False,
    ) -> None:
        folder.require_own()
        self._options, self._trial = options, TrackedTrial(folder, values)
        with ExitStack() as held:
            held.enter_context(hold(folder.path / LOCK, "mirroring", wait=False))
            self._sink = make_sink(options, self._trial, program)
            self._file = folder.path / self._sink.state_file
            if anew:
                self._open()
                self._sink.remove()
                self._file.unlink(missing_ok=True)
            self._open()
            self._held = held.pop_all()

    def close(self) -> None:
        """Let other processes mirror the trial."""
        self._held.close()

    @property
    def is_complete(self) -> bool:
        """Return whether the run shows the present results."""
        return self._state["complete"] is not None and self._state["complete"] == self._trial.results_hash()

    def add_curves(self) -> None:
        """Log the records that were written since the last call."""
        if self.is_complete:
            return
        for name, newest, points in self._trial.curves(self._state["logged"]):
            self._sink.log(points)
            self._state["logged"][name] = newest
        self._save()

    def end(self) -> None:
        """Log the rest, and close the run as the files say that the trial ended: failed, done, or else killed."""
        if self.is_complete:
            return
        if self._state["complete"] is not None:  # results that were there when it began are replaced by others
            self._open()
        self.add_curves()
        folder = self._trial.folder
        if folder.has_failed():
            self._sink.stop("FAILED", folder.failure())
        elif (results := folder.sound_record()) is None:
            self._sink.stop("KILLED", None)
        else:
            images, with_model = int(self._options["images"]), bool(self._options.get("model"))
            self._sink.complete(self._trial.summary(results, images, with_model))
            self._state["complete"] = self._trial.results_hash()
        self._save()

    def _open(self) -> None:
        self._state = self._sink.open(read_state(self._file), self._trial.results_hash())
        self._save()

    def _save(self) -> None:
        write_json(self._file, self._state)


def make_sink(options: dict[str, Any], trial: TrackedTrial, program: str | None) -> Sink:
    """The trial's place in the tracker that ``tracking.sink`` names."""
    match options.get("sink", DEFAULT):
        case "tensorboard":
            from gsbench.tracking.tensorboard_sink import TensorBoardSink

            return TensorBoardSink(trial)
        case "wandb":
            from gsbench.tracking.wandb_sink import WandbSink

            return WandbSink(options, trial)
        case _:
            from gsbench.tracking.mlflow_sink import MlflowSink

            return MlflowSink(options, trial, program)
