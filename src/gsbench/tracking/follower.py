"""Mirroring a trial: its files are read, and what they gained is sent to its tracker.

`sync` does so once, for trials that have ended. `follow` is a process beside a sweep, which looks again and again until
its trials have ended. The files are the truth: how far a trial has come and how it ended is read there.
"""

import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from queue import Empty, Queue
from typing import Any, NoReturn

from gsbench.errors import InputError
from gsbench.files import write_json
from gsbench.runs.layout import CONFIG, FAILED, RESULTS
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import BusyError, hold
from gsbench.tracking.mirror import TRACKER_FAILED, MirrorError
from gsbench.tracking.mlflow_sink import untyped_address
from gsbench.tracking.trial import DEFAULT, Sink, TrackedTrial, name_of, read_state
from gsbench.words import counted

LOCK = ".mlflow.lock"  # one process at a time mirrors a trial, to whichever tracker
SECONDS_AFTER_PARENT = 10.0  # to tell the tracker that the trials' process is gone


class TrackerRun:
    """The run of the trial in ``folder``, opened anew or gone on with, and locked until it is closed.

    ``options`` are the settings ``tracking``, ``values`` the whole configuration. Raises BusyError where another
    process mirrors the trial, and whatever the tracker raises.
    """

    def __init__(self, folder: TrialFolder, options: dict[str, Any], values: dict[str, Any]) -> None:
        folder.require_own()
        self._options, self._trial = options, TrackedTrial(folder, values)
        with ExitStack() as held:
            held.enter_context(hold(folder.path / LOCK, "mirroring", wait=False))
            self._sink = make_sink(options, self._trial)
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
        write_json(self._file, self._state)

    def end(self) -> None:
        """Log the rest, and close the run as the files say that the trial ended: failed, done, or else killed."""
        if self.is_complete:
            return
        if self._state["complete"] is not None:  # results that were there when it began are replaced by others
            self._open()
        self.add_curves()
        folder = self._trial.folder
        if folder.has_failed():
            self._sink.stop("FAILED", folder.failure().reason)
        elif (results := folder.sound_record()) is None:
            self._sink.stop("KILLED", None)
        else:
            images, with_model = int(self._options["images"]), bool(self._options.get("model"))
            self._sink.complete(self._trial.summary(results, images, with_model))
            self._state["complete"] = self._trial.results_hash()
        write_json(self._file, self._state)

    def _open(self) -> None:
        self._state = self._sink.open(read_state(self._file), self._trial.results_hash())
        write_json(self._file, self._state)


def make_sink(options: dict[str, Any], trial: TrackedTrial) -> Sink:
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

            return MlflowSink(options, trial)


# ---- once, after the end


def sync(folders: Iterable[TrialFolder], uri: str | None) -> Iterator[str]:
    """Mirror what the tracker missed of ended trials; yields a line for each that is new there or left out, and one
    for all.

    Raises MirrorError where the tracker does not take it.
    """
    new = known = 0
    for folder in folders:
        state = folder.state()
        if state == "damaged":
            yield f"left out: {folder.label}: damaged, see gsbench status"
        if state not in ("done", "failed"):
            continue
        try:
            values = folder.configuration()
        except InputError as error:
            yield f"left out: {error}"
            continue
        options = values["tracking"] | ({"uri": uri} if uri else {})
        # A runs folder of somebody else's must not send what is here, or our passwords, to an address of theirs.
        if strange := untyped_address(options, uri):
            yield (
                f"left out: {folder.label}: its configuration names the tracker {strange}, and --uri {strange} was "
                "not typed"
            )
            continue
        try:
            is_new = mirror_ended(folder, options, values)
        except BusyError:
            yield f"{folder.label} is being mirrored by another process"
            continue
        except Exception as error:  # whatever the tracker raises
            raise refused(folder, options, error) from error
        new, known = new + is_new, known + (not is_new)
        if is_new:
            yield f"mirrored {folder.label}"
    yield f"{counted(new, 'trial')} mirrored now, {known} before"


def mirror_ended(folder: TrialFolder, options: dict[str, Any], values: dict[str, Any]) -> bool:
    """Mirror what is missing of an ended trial; False if nothing was. Raises what `TrackerRun` raises."""
    run = TrackerRun(folder, options, values)
    try:
        if run.is_complete:
            return False
        run.end()
        return True
    finally:
        run.close()


def refused(folder: TrialFolder, options: dict[str, Any], error: Exception) -> MirrorError:
    """The error of a trial that the tracker does not take: one line, whatever library it comes from."""
    lines = str(error).strip().splitlines()
    reason = f"{type(error).__name__}: {lines[0][:200] if lines else ''}"
    return MirrorError(f"{name_of(options)} does not take {folder.label} ({reason})")


# ---- beside a sweep

Input = Queue[str | None]  # lines, and None for the end


def follow() -> NoReturn:
    """Mirror the trials whose folders come as lines of the input, until they have ended and no more lines come.

    The words of the command: the time between two looks, and the patience of the process that waits for this one, in s.
    """
    pause, patience = map(float, sys.argv[2:4])
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    told: Input = Queue()
    threading.Thread(target=_read_input, args=(told, patience), daemon=True).start()
    code = 0
    try:
        _follow(told, pause)
    except Exception as error:  # noqa: BLE001 - whatever the tracker raises
        code = TRACKER_FAILED
        traceback.print_exc()
        print(" ".join(str(error).split()), file=sys.stderr, flush=True)
    os._exit(code)  # no library is torn down: one might hang or crash in it


def _follow(told: Input, pause: float) -> None:
    trials: list[_Followed] = []
    last = False
    while not last:
        with suppress(Empty):
            place = told.get(timeout=pause)
            while place is not None:
                trials.append(_Followed(TrialFolder(Path(place))))
                place = told.get_nowait()
            last = True
        for trial in trials:
            try:
                trial.catch_up(last)
            except BusyError:
                pass
            except Exception as error:  # whatever the tracker raises: it is tried again, and at last said
                if last:
                    raise refused(trial.folder, trial.options, error) from error
        trials = [trial for trial in trials if not trial.has_ended]


class _Followed:
    """A trial that is to be mirrored; its run is opened when the trial runs or has ended, or at the end of all."""

    def __init__(self, folder: TrialFolder) -> None:
        self.folder, self.has_ended = folder, False
        self.options: dict[str, Any] = {}
        self._told = time.time()
        self._run: TrackerRun | None = None

    def catch_up(self, last: bool) -> None:
        """Send what the files have gained, and that the trial has ended; ``last`` says that all trials have."""
        state = self.folder.state()  # before the curves are read, so that an ended trial's are whole
        waits = state != "running" and self._run is None and not self._has_ended_since()
        if not (self.folder.path / CONFIG).exists() or (waits and not last):  # for its turn
            return
        if self._run is None:
            values = self.folder.configuration()
            self.options = values["tracking"]
            self._run = TrackerRun(self.folder, self.options, values)
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


def _read_input(told: Input, patience: float) -> None:
    for line in sys.stdin:
        told.put(line.rstrip("\n"))
    told.put(None)
    time.sleep(patience + SECONDS_AFTER_PARENT)
    os._exit(1)  # whatever hangs
