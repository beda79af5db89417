"""The mirror's own process: it follows the files of a trial until that has ended, or mirrors all that have.

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
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NoReturn, TextIO

from gsbench.errors import InputError
from gsbench.runs.experiments import places_of_trials
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import BusyError, hold
from gsbench.tracking.client import untyped_address
from gsbench.tracking.mirror import TRACKER_FAILED
from gsbench.tracking.run import LOCK, TrackerRun, mirror_trial
from gsbench.tracking.sink import name_of
from gsbench.tracking.trial import TrackedTrial
from gsbench.words import counted

SECONDS_AFTER_PARENT = 10.0  # to tell the tracker that the trial's process is gone


class MissedError(Exception):
    """A trial that the tracker does not take; the text is the reason."""


def follow() -> NoReturn:
    """Mirror the trial that the words of the command name (its folder, the program that runs it) until it has ended."""
    folder, program = TrialFolder(Path(sys.argv[2])), sys.argv[3]
    values = folder.configuration()
    trial, options = TrackedTrial(folder, values), values["tracking"]
    _serve(lambda ended, out: _follow(trial, options, program, ended), float(options["patience_seconds"]))


def sync() -> NoReturn:
    """Mirror what a tracker missed of all ended trials (address, "anew" or "", experiments' folders)."""
    uri, anew, homes = sys.argv[2] or None, bool(sys.argv[3]), sys.argv[4:]

    def work(ended: threading.Event, out: TextIO) -> None:
        for line in _sync(uri, anew, homes):
            print(line, file=out, flush=True)

    _serve(work, patience=0)


def _follow(trial: TrackedTrial, options: dict[str, Any], program: str, ended: threading.Event) -> None:
    """Send now and then what the files have gained, and at the end that the trial has ended.

    A tracker that fails is tried again at the next occasion.
    """
    run: TrackerRun | None = None
    with ExitStack() as held:

        def caught_up() -> TrackerRun:
            nonlocal run
            if run is None:
                with ExitStack() as lock:
                    lock.enter_context(hold(trial.folder.path / LOCK, "mirroring", wait=False))
                    run = TrackerRun(options, trial, program)
                    held.push(lock.pop_all())
            run.add_curves()
            return run

        pause = 0.0  # the dashboard shows a trial when it begins
        while not ended.wait(pause):
            pause = float(options["flush_seconds"])
            with suppress(Exception):  # what lasts until the end is said then
                caught_up()
        with suppress(BusyError):  # another process mirrors it
            caught_up().end()


def _sync(uri: str | None, anew: bool, homes: Sequence[str]) -> Iterator[str]:
    """Mirror the ended trials of the experiments in ``homes``; yields lines for people."""
    new = known = 0
    for folder in [TrialFolder(Path(place)) for home in homes for place in sorted(places_of_trials(Path(home)))]:
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
        if strange := untyped_address(options, uri):
            yield (
                f"left out: {folder.label}: its configuration names the tracker {strange}, and --uri {strange} was "
                "not typed"
            )
            continue
        try:
            is_new = mirror_trial(options, folder.path, values, anew)
        except BusyError:
            yield f"{folder.label} is being mirrored by another process"
            continue
        except Exception as error:  # whatever the tracker raises
            raise MissedError(f"{name_of(options)} does not take {folder.label} ({kind_and_words(error)})") from error
        if is_new:
            yield f"mirrored {folder.label}"
        new, known = new + is_new, known + (not is_new)
    yield f"{counted(new, 'trial')} mirrored, {known} were"


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
