"""The run of a trial in a tracker: what is missing there is sent, and how far that has come stands in a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsbench.files import write_json
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import hold
from gsbench.tracking.sink import DEFAULT, Sink
from gsbench.tracking.trial import TrackedTrial, read_state

LOCK = ".mlflow.lock"  # one process at a time mirrors a trial, to whichever tracker


class TrackerRun:
    """The trial's run, opened anew or gone on with."""

    def __init__(self, options: dict[str, Any], trial: TrackedTrial, program: str | None = None) -> None:
        self.trial = trial
        self.sink = make_sink(options, trial, program)
        self._options = options
        self._file = trial.folder.path / self.sink.state_file
        self._open()

    def _open(self) -> None:
        self.state = self.sink.open(read_state(self._file), self.trial.results_hash())
        self._save()

    @property
    def is_complete(self) -> bool:
        """Return whether the run shows the present results."""
        return self.state["complete"] is not None and self.state["complete"] == self.trial.results_hash()

    def add_curves(self) -> None:
        """Log the records that were written since the last call."""
        if self.is_complete:
            return
        for name, newest, points in self.trial.curves(self.state["logged"]):
            self.sink.log(points)
            self.state["logged"][name] = newest
        self._save()

    def end(self) -> None:
        """Log the rest, and close the run as the files say that the trial ended: failed, done, or else killed."""
        if self.is_complete:
            return
        if self.state["complete"] is not None:  # results that were there when it began are replaced by others
            self._open()
        self.add_curves()
        folder = self.trial.folder
        if folder.has_failed():
            self.sink.stop("FAILED", folder.failure())
        elif (results := folder.sound_record()) is None:
            self.sink.stop("KILLED", None)
        else:
            images, with_model = int(self._options["images"]), bool(self._options.get("model"))
            self.sink.complete(self.trial.summary(results, images, with_model))
            self.state["complete"] = self.trial.results_hash()
        self._save()

    def remove(self) -> None:
        """Delete the run; the files stay."""
        self.sink.remove()
        self._file.unlink(missing_ok=True)

    def _save(self) -> None:
        write_json(self._file, self.state)


def mirror_trial(options: dict[str, Any], folder: Path, values: dict[str, Any], anew: bool = False) -> bool:
    """Mirror what is missing of an ended trial; False if nothing was missing. Raises what the tracker raises.

    With ``anew``, the run that mirrors it so far is deleted, and another made from the files alone.
    """
    trial = TrackedTrial(TrialFolder(folder), values)
    trial.folder.require_own()
    with hold(folder / LOCK, "mirroring", wait=False):
        run = TrackerRun(options, trial)
        if anew:
            run.remove()
            run = TrackerRun(options, trial)
        if run.is_complete:
            return False
        run.end()
    return True


def make_sink(options: dict[str, Any], trial: TrackedTrial, program: str | None) -> Sink:
    """The trial's place in the tracker that ``tracking.sink`` names.

    ``program`` is what runs the trial at this moment; None where the trial has ended.
    """
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
