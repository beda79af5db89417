"""The mirror's own process: it follows the files of trials until they have ended.

The files are the truth: what a trial is, how far it has come and how it ended is read there.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from queue import Empty, Queue
from typing import Any, NoReturn, TextIO

from gsbench.files import write_json
from gsbench.runs.layout import FAILED, RESULTS
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import BusyError, hold
from gsbench.tracking.mirror import TRACKER_FAILED
from gsbench.tracking.sink import DEFAULT, Sink, name_of
from gsbench.tracking.trial import TrackedTrial, read_state

LOCK = ".mlflow.lock"  # one process at a time mirrors a trial, to whichever tracker
SECONDS_AFTER_PARENT = 10.0  # to tell the tracker that the trials' process is gone

Input = Queue[str | None]  # lines, and None for the end


class MissedError(Exception):
    """A trial that the tracker does not take; the text is the reason."""


def follow() -> NoReturn:
    """Mirror the trials whose folders come as lines of the input, until they have ended; says what it mirrored.

    The words of the command: the program that runs the trials, "" where they have ended long ago; the time between two
    looks and the patience of the process that waits for this one, in s; the tracker's address if one was typed.
    """
    program, pause, patience, uri = sys.argv[2:6]

    def work(told: Input, out: TextIO) -> None:
        trials: list[_Followed] = []
        last = False
        while not last:
            with suppress(Empty):
                place = told.get(timeout=float(pause))
                while place is not None:
                    trials.append(_Followed(TrialFolder(Path(place)), program or None))
                    place = told.get_nowait()
                last = True
            for trial in trials:
                try:
                    trial.catch_up(last, uri or None)
                except BusyError:
                    trial.said = f"{trial.folder.label} is being mirrored by another process"
                except Exception as error:  # whatever the tracker raises: it is tried again, and at last said
                    if last:
                        reason = kind_and_words(error)
                        raise MissedError(f"{trial.tracker} does not take {trial.folder.label} ({reason})") from error
                if last and not program:  # else nobody reads it
                    print(trial.said, file=out, flush=True)
            trials = [trial for trial in trials if not trial.has_ended]

    _serve(work, float(patience))


class _Followed:
    """A trial that is to be mirrored; its run is opened when the trial runs or has ended, or at the end of all."""

    def __init__(self, folder: TrialFolder, program: str | None) -> None:
        self.folder, self.said, self.has_ended, self.tracker = folder, "", False, "the tracker"
        self._program, self._told = program, time.time()
        self._run: TrackerRun | None = None

    def catch_up(self, last: bool, uri: str | None) -> None:
        """Send what the files have gained, and that the trial has ended; ``last`` says that all trials have."""
        if self._program is None and not last:
            return
        state = self.folder.state()  # before the curves are read, so that an ended trial's are whole
        waits = state != "running" and self._run is None and not self._has_ended_since()
        if state == "missing" or (waits and not last):  # for its turn
            return
        if self._run is None:
            values = self.folder.configuration()
            options = values["tracking"] | ({"uri": uri} if uri else {})
            self.tracker = name_of(options)
            self._run = TrackerRun(options, self.folder, values, self._program)
            self.said = "" if self._run.is_complete else f"mirrored {self.folder.label}"
        self._run.add_curves()
        if state != "running":
            self._run.end()
            self._run.close()
            self.has_ended = True

    def _has_ended_since(self) -> bool:
        """Return whether the trial has ended since it was told of: what it left before is of an earlier run."""
        for name in (RESULTS, FAILED):
            with suppress(OSError):
                if (self.folder.path / name).stat().st_mtime >= self._told:
                    return True
        return False


class TrackerRun:
    """The run of the trial in ``folder``, opened anew or gone on with, and locked until it is closed.

    ``program`` is what runs the trial at this moment; None where the trial has ended. Raises BusyError where another
    process mirrors the trial, and whatever the tracker raises.
    """

    def __init__(
        self,
        options: dict[str, Any],
        folder: TrialFolder,
        values: dict[str, Any],
        program: str | None = None,
    ) -> None:
        folder.require_own()
        self._options, self._trial = options, TrackedTrial(folder, values)
        with ExitStack() as held:
            held.enter_context(hold(folder.path / LOCK, "mirroring", wait=False))
            self._sink = make_sink(options, self._trial, program)
            self._file = folder.path / self._sink.state_file
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


def _serve(work: Callable[[Input, TextIO], object], patience: float) -> NoReturn:
    """Do ``work``, which is given the lines of the input and a stream to print to; then end the process.

    ``patience`` is the time in s for which the process that waits for this one does so; soon after it, we are gone too.
    """
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    out = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what MLflow prints is no line of ours
    told: Input = Queue()
    threading.Thread(target=_read_input, args=(told, patience), daemon=True).start()
    code = 0
    try:
        work(told, out)
        out.flush()
    except Exception as error:  # noqa: BLE001 - whatever the tracker raises
        code = TRACKER_FAILED
        traceback.print_exc()
        print(error if isinstance(error, MissedError) else kind_and_words(error), file=sys.stderr, flush=True)
    os._exit(code)  # no library is torn down: one might hang or crash in it


def _read_input(told: Input, patience: float) -> None:
    for line in sys.stdin:
        told.put(line.rstrip("\n") or None)  # an empty line: no more will come, and we have all the time that it takes
    told.put(None)
    time.sleep(patience + SECONDS_AFTER_PARENT)
    os._exit(1)  # whatever hangs


def kind_and_words(error: Exception) -> str:
    """Kind and first words of an error, whatever library it comes from."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0][:200] if lines else ''}"
