"""Follower of a trial's files until the trial, or its process, is gone; runs in the mirror's own process.

The files are the truth: what a trial is, how far it has come and how it ended is read there. The end of the input
says that it has ended.
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
from typing import Any, NoReturn, TextIO

from gsbench.errors import InputError
from gsbench.runs.experiments import places_of_trials
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import BusyError, hold
from gsbench.tracking.address import untyped_address
from gsbench.tracking.client import connect, ensure_experiment
from gsbench.tracking.process import TRACKER_FAILED
from gsbench.tracking.sink import name_of
from gsbench.tracking.tracked_trial import LOCK, TrackedTrial, mirror_trial
from gsbench.words import counted

SECONDS_AFTER_PARENT = 10.0  # to tell the tracker that the trial's process is gone


def follow() -> NoReturn:
    """Mirror the trial that the words of the command name (runs folder, trial's folder, program) until it has ended."""
    runs, folder, program = Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4]

    def work(ended: threading.Event, out: TextIO) -> None:
        values = TrialFolder(folder).configuration()
        _follow(Follower(values["tracking"], runs, folder, values, program), ended)

    _serve(work, patience=float(TrialFolder(folder).configuration()["tracking"]["patience_seconds"]))


def prepare() -> NoReturn:
    """Create MLflow's tables and an experiment (runs folder, experiment, address, patience in s)."""
    runs, experiment, uri, patience = Path(sys.argv[2]), sys.argv[3], sys.argv[4] or None, float(sys.argv[5])
    _serve(lambda ended, out: ensure_experiment(connect(uri, runs), experiment, runs), patience)


def sync() -> NoReturn:
    """Mirror what a tracker missed of all ended trials (runs folder, address, "anew" or "", experiments' folders)."""
    runs, uri, anew, homes = Path(sys.argv[2]), sys.argv[3] or None, bool(sys.argv[4]), sys.argv[5:]

    def work(ended: threading.Event, out: TextIO) -> None:
        new = known = 0
        for folder in (folder for home in homes for folder in sorted(map(Path, places_of_trials(Path(home))))):
            state = TrialFolder(folder).state()
            if state == "damaged":
                print(f"left out: {TrialFolder(folder).label}: damaged, see gsbench status", file=out, flush=True)
            if state not in ("done", "failed"):
                continue
            try:
                values = TrialFolder(folder).configuration()
            except InputError as error:
                print(f"left out: {error}", file=out, flush=True)
                continue
            if strange := untyped_address(values["tracking"] | ({"uri": uri} if uri else {}), uri):
                text = f"its configuration names the tracker {strange}, and --uri {strange} was not typed"
                print(f"left out: {TrialFolder(folder).label}: {text}", file=out, flush=True)
                continue
            if _sync_one(folder, values, runs, uri, anew, out):
                new += 1
                print(f"mirrored {TrialFolder(folder).label}", file=out, flush=True)
            else:
                known += 1
        print(f"{counted(new, 'trial')} mirrored, {known} were", file=out)

    _serve(work, patience=0)


def _sync_one(folder: Path, values: dict[str, Any], runs: Path, uri: str | None, anew: bool, out: TextIO) -> bool:
    """Return whether something of the trial was missing. Raises MissedError where the tracker does not take it."""
    options = values["tracking"] | ({"uri": uri} if uri else {})
    try:
        return mirror_trial(options, runs, folder, values, anew)
    except BusyError:
        print(f"{TrialFolder(folder).label} is being mirrored by another process", file=out, flush=True)
        return False
    except Exception as error:  # whatever the tracker raises
        raise MissedError(
            f"{name_of(options)} does not take {TrialFolder(folder).label} ({kind_and_words(error)})"
        ) from error


class MissedError(Exception):
    """A trial that the tracker does not take; the text is the reason."""


class Follower:
    """A trial in progress, mirrored now and then; a tracker that fails is tried again at the next occasion."""

    def __init__(self, options: dict[str, Any], runs: Path, folder: Path, values: dict[str, Any], program: str) -> None:
        self.seconds_between = float(options["flush_seconds"])
        self._folder = folder
        self._open = lambda: TrackedTrial(options, runs, folder, values, program)
        self._run: TrackedTrial | None = None
        self._lock = ExitStack()

    def catch_up(self) -> None:
        """Log what the files have gained. Raises what the tracker raises, BusyError where another process mirrors."""
        if self._run is None:
            with ExitStack() as stack:
                stack.enter_context(hold(self._folder / LOCK, "mirroring", wait=False))
                self._run = self._open()
                self._lock = stack.pop_all()
        self._run.add_curves()

    def end(self) -> None:
        """Log the rest, and that the trial has ended; raises as `catch_up` does."""
        try:
            self.catch_up()
            assert self._run is not None
            self._run.end()
        finally:
            self._lock.close()


def _follow(trial: Follower, ended: threading.Event) -> None:
    pause = 0.0  # the dashboard shows a trial when it begins
    while not ended.wait(pause):
        pause = trial.seconds_between
        with suppress(Exception):  # what lasts until the end is said then
            trial.catch_up()
    with suppress(BusyError):  # it is mirrored
        trial.end()


def _serve(work: Callable[[threading.Event, TextIO], object], patience: float) -> NoReturn:
    """Do ``work``, which is given the event that the input has ended, and a stream to print to; then end the process.

    ``patience`` is the time in s for which the process that waits for this one does so; soon after it, we are gone too.
    """
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    out = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what MLflow prints is no line of ours
    ended = threading.Event()
    threading.Thread(target=_watch_input, args=(ended, patience), daemon=True).start()
    code = 0
    try:
        work(ended, out)
        out.flush()
    except Exception as error:  # noqa: BLE001 - whatever the tracker raises
        code = TRACKER_FAILED
        traceback.print_exc()
        print(error if isinstance(error, MissedError) else kind_and_words(error), file=sys.stderr, flush=True)
    os._exit(code)  # no library is torn down: one might hang or crash in it


def _watch_input(ended: threading.Event, patience: float) -> None:
    while os.read(sys.stdin.fileno(), 1):
        pass
    ended.set()
    time.sleep(patience + SECONDS_AFTER_PARENT)
    os._exit(1)  # whatever hangs


def kind_and_words(error: Exception) -> str:
    """Kind and first words of an error, whatever library it comes from."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0][:200] if lines else ''}"
