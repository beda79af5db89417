"""Mirroring: a process beside the trials reads their files and sends new records to trackers.

Why a process: a tracker's client may hang in a socket, a lock or a C library for any time. A
hanging thread cannot be ended, and a thread that is inside a C library when the interpreter exits
crashes the process, after a trial that was complete. A process can be killed.

`Mirror` starts the process, and at the end waits for it a bounded time. `follow` is the main
function of the process. It gets folders and settings on stdin, and reads everything else from
files. Its exit code says how it ended, and the last line on its stderr says why.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from contextlib import ExitStack, suppress
from pathlib import Path
from queue import Empty, Queue
from typing import Any, NoReturn

from gsbench.runs.layout import CONFIG, FAILED, RESULTS
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.isolate import describe_exit, error_lines, python_command
from gsbench.system.locks import BusyError
from gsbench.system.own_modules import allowed_modules
from gsbench.system.programs import safe_environment
from gsbench.tracking.tracker_run import (
    ERRORS,
    Pages,
    TrackerRun,
    place_for,
    refusal,
    renew_pages,
    tracker_name,
    with_absolute_address,
)

log = logging.getLogger(__name__)

# exit code if the tracker, or a file, is at fault: the last line on stderr says why
TRACKER_FAILED = 3
SECONDS_BETWEEN_TABLES = 60.0  # an experiment of thousands of trials takes seconds to read
SECONDS_TO_STOP = 3.0  # patience after a signal that asks to end


class Mirror:
    """Mirrors the trials that begin within a ``with`` block, by one process; ``idle``: none.

    At the end of the block, it waits a bounded time for the tracker. Errors of the tracker are
    never raised: one line in the log says what is missing.
    """

    def __init__(self, idle: bool = False) -> None:
        self._idle = idle
        self._process: subprocess.Popen[bytes] | None = None
        self._options: dict[str, Any] = {}

    def __enter__(self) -> Mirror:
        return self

    def follow(self, folder: Path, options: dict[str, Any]) -> None:
        """Mirror the trial in ``folder`` with the settings ``tracking`` from start to end."""
        if self._idle or not options["enabled"]:
            return
        self._options = options = with_absolute_address(options)
        try:
            if self._process is not None and self._process.poll() is not None:
                self._finish(self._process, 0)
            if self._process is None:
                self._process = self._start()
            assert self._process.stdin is not None
            self._process.stdin.write(f"{json.dumps([str(folder), options])}\n".encode())
            self._process.stdin.flush()
        except OSError as error:
            self._warn(error)

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        stopped = kind is not None and not issubclass(kind, Exception)
        if self._process is not None:
            self._finish(
                self._process,
                SECONDS_TO_STOP if stopped else float(self._options["patience_seconds"]),
            )

    def _start(self) -> subprocess.Popen[bytes]:
        """A fresh interpreter that runs `gsbench.tracking.mirror.follow`.

        Raises OSError where it cannot start.
        """
        self._held = ExitStack()  # as long as the process runs
        folder = self._held.enter_context(place_for(self._options))
        self._errors = self._held.enter_context(tempfile.TemporaryFile())  # noqa: SIM115
        words = (str(self._options["flush_seconds"]), str(self._options["patience_seconds"]))
        return subprocess.Popen(
            python_command(__name__, "follow", *words),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,  # what MLflow prints
            stderr=self._errors,
            cwd=folder,
            env=safe_environment(),
            # Ctrl-C must reach only the trials' process, which then ends this one
            start_new_session=True,
        )

    def _finish(self, process: subprocess.Popen[bytes], seconds: float) -> None:
        """Close the process's input, wait for its end ``seconds`` at most, then kill it."""
        self._process = None
        with self._held, process:
            try:
                process.communicate(timeout=seconds)
            except subprocess.TimeoutExpired:
                log.warning(
                    "tracking: %s is slow; `gsbench sync` mirrors the rest later",
                    tracker_name(self._options),
                )
                return
            finally:  # also where a signal interrupts the wait
                process.kill()
            self._errors.seek(0)
            stderr = self._errors.read()
        if process.returncode == TRACKER_FAILED:
            text = stderr.decode("utf-8", "replace").strip()
            log.debug("tracking failed:\n%s", text)
            self._warn(text.splitlines()[-1])
        elif process.returncode != 0:
            self._warn(
                f"the mirror {describe_exit(process.returncode)}; its last lines: "
                f"{error_lines(stderr)}"
            )

    def _warn(self, error: object) -> None:
        log.warning(
            "tracking: %s; the files are complete, `gsbench sync` mirrors them later", error
        )


# to tell the tracker how trials ended after the sweep's process is gone
SECONDS_AFTER_PARENT = 10.0


# ---- beside a sweep

Lines = Queue[str | None]  # of stdin; None is the end


def follow() -> NoReturn:
    """Mirror the trials that come on stdin, until it and the trials have ended.

    Each line is JSON: a trial's folder, and its settings ``tracking``.

    Arguments of the process: the time between two readings of the files, and how long the parent
    waits for this process at the end; both in seconds.
    """
    pause, patience = map(float, sys.argv[2:4])
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    lines: Lines = Queue()
    threading.Thread(target=_read_input, args=(lines, patience), daemon=True).start()
    code = 0
    try:
        _follow(lines, pause)
    except Exception as error:  # noqa: BLE001 - any error of the tracker's client
        code = TRACKER_FAILED
        traceback.print_exc()
        print(" ".join(str(error).split()), file=sys.stderr, flush=True)
    os._exit(code)  # skips the clean-up of libraries, which might hang or crash


def _follow(lines: Lines, pause: float) -> None:
    trials: list[_FollowedTrial] = []
    pages: Pages = {}
    renewed_at = 0.0
    last = False
    while not last:
        with suppress(Empty):
            line = lines.get(timeout=pause)
            while line is not None:
                folder, options = json.loads(line)
                trials.append(_FollowedTrial(TrialFolder(Path(folder)), options))
                line = lines.get_nowait()
            last = True
        for trial in trials:
            try:
                trial.catch_up(last)
            except BusyError:
                pass
            except ERRORS as error:  # tried again, and raised the last time
                if last:
                    raise refusal(trial.folder, trial.options, error) from error
        for trial in trials:
            if trial.has_ended:
                pages[trial.folder.home, trial.options["uri"]] = trial.folder, trial.options
        trials = [trial for trial in trials if not trial.has_ended]
        if last or time.monotonic() - renewed_at > SECONDS_BETWEEN_TABLES:
            renew_pages(pages)
            renewed_at = time.monotonic()


class _FollowedTrial:
    """A trial to mirror with the settings ``options`` of tracking.

    Its run is opened once the trial runs or has ended, or when the sweep ends.
    """

    def __init__(self, folder: TrialFolder, options: dict[str, Any]) -> None:
        # These are the settings that were checked: a trial that has not begun may have a stranger's
        # `config.yaml`, with the stranger's address.
        self.folder, self.options, self.has_ended = folder, options, False
        self._added_at = time.time()
        self._run: TrackerRun | None = None

    def catch_up(self, last: bool) -> None:
        """Send the new records, and the trial's end once it has ended.

        ``last`` says that the sweep has ended.
        """
        # The state is read before the curves: if it says that the trial has ended, the curves are
        # complete.
        state = self.folder.state()
        is_waiting = state != "running" and self._run is None and not self._has_ended_since()
        if not (self.folder.path / CONFIG).exists() or (is_waiting and not last):
            return
        if self._run is None:
            values = self.folder.configuration()
            # the permissions that this process's parent got on its command line
            self._run = TrackerRun(self.folder, self.options, values, tuple(allowed_modules()))
        self._run.add_curves()
        if state != "running":
            self._run.end()
            self._run.close()
            self.has_ended = True

    def _has_ended_since(self) -> bool:
        """Return whether the trial has ended since it was added.

        Result files that are older are of an earlier run.
        """
        for name in (RESULTS, FAILED):
            with suppress(OSError):
                if (self.folder.path / name).stat().st_mtime >= self._added_at:
                    return True
        return False


def _read_input(lines: Lines, patience: float) -> None:
    for line in sys.stdin:
        lines.put(line.rstrip("\n"))
    lines.put(None)
    # The parent kills this process after its patience. If the parent was killed itself, this ends
    # the process, even while the tracker's client hangs.
    time.sleep(patience + SECONDS_AFTER_PARENT)
    os._exit(1)
