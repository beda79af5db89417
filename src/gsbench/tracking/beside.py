"""`gsbench sync` beside a sweep: a process that sends to trackers what the trials have written.

Why a process: a tracker's client may hang in a socket, a lock or a C library for any time, and
crash the interpreter when it exits. A process can be killed, and harms no trial.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

from gsbench.parsing import one_line
from gsbench.runs.layout import FAILED, RESULTS
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.isolate import describe_exit
from gsbench.system.programs import safe_environment

log = logging.getLogger(__name__)

SECONDS_TO_STOP = 3.0  # patience after a signal that asks to end
# between two sends: the start of a process that imports a tracker takes 4 CPU-seconds
SECONDS_BETWEEN_SENDS = 15.0
# to tell the tracker how trials ended after the sweep's process was killed
SECONDS_AFTER_PARENT = 10.0


class Mirror:
    """Sends the trials that begin within a ``with`` block to their trackers; ``idle``: sends none.

    While the block runs, a process sends every ``tracking.flush_seconds``, and soon after a trial
    has ended; at the end it gets ``tracking.patience_seconds``. Errors of a tracker are never
    raised: one line in the log says what is missing.
    """

    def __init__(self, idle: bool = False) -> None:
        self._idle = idle
        self._followed: dict[Path, tuple[float, dict[str, Any]]] = {}  # since when, with settings
        self._looks, self._stop = threading.Event(), threading.Event()
        self._process: subprocess.Popen[str] | None = None
        self._thread: threading.Thread | None = None
        self._fault = ""

    def __enter__(self) -> Mirror:
        return self

    def follow(self, folder: Path, values: dict[str, Any]) -> None:
        """Mirror the trial in ``folder`` with the configuration ``values`` from start to end."""
        if self._idle or not values["tracking"]["enabled"]:
            return
        self._followed[folder] = time.time(), values
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, daemon=True)
            self._thread.start()

    def trial_ended(self) -> None:
        """Send soon, since a trial has ended."""
        self._looks.set()

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        if self._thread is None:
            return
        stopped = kind is not None and not issubclass(kind, Exception)
        _, values = next(iter(self._followed.values()), (0, {}))
        patience = float(values["tracking"]["patience_seconds"]) if values else SECONDS_TO_STOP
        self._stop.set()
        self._looks.set()
        try:
            self._thread.join(min(patience, SECONDS_TO_STOP) if stopped else patience)
            if self._thread.is_alive():
                self._fault = "the tracker is slow"
        finally:  # also where a signal interrupts the wait
            with suppress(AttributeError, OSError):
                self._process.kill()  # type: ignore[union-attr]
        if self._fault:
            log.warning(
                "tracking: %s; the files are complete, `gsbench sync` sends them later", self._fault
            )

    def _run(self) -> None:
        """Send until the block has ended, and then once more."""
        last = False
        while not last:
            pauses = [
                values["tracking"]["flush_seconds"] for _, values in [*self._followed.values()]
            ]
            pause = min(pauses, default=1.0)
            self._looks.wait(pause)
            self._looks.clear()
            last = self._stop.is_set()
            self._send()
            self._stop.wait(min(pause, SECONDS_BETWEEN_SENDS))

    def _send(self) -> None:
        """Send the followed trials of each experiment, and forget those that have ended."""
        begun = {place: added for place, added in list(self._followed.items()) if place.is_dir()}
        ended = [place for place, (since, _) in begun.items() if _has_ended_since(place, since)]
        homes: dict[Path, list[Path]] = {}
        for place in begun:
            homes.setdefault(TrialFolder(place).home, []).append(place)
        for home, places in homes.items():
            self._fault = self._sync(home, places, begun[places[0]][1])
            if not self._fault:
                for place in {*places} & {*ended}:
                    self._followed.pop(place, None)

    def _sync(self, home: Path, places: list[Path], values: dict[str, Any]) -> str:
        """Run ``gsbench sync`` for these trials; returns the reason of a failure, else ""."""
        words = [sys.executable, "-P", "-m", "gsbench", "sync", home.name]
        words += [f"--beside={os.getpid()}", f"allow_targets={json.dumps(permissions(values))}"]
        for place in places:
            words += ["--trial", place.relative_to(home).as_posix()]
        environment = safe_environment() | {"GSBENCH_RUNS": str(home.parent)}
        try:
            self._process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                env=environment,
                # Ctrl-C must reach only the trials' process, which then ends this one
                start_new_session=True,
            )
        except OSError as error:
            return str(error)
        said = self._process.communicate()[1]
        log.debug("gsbench sync %s: %s", home.name, said)
        if self._process.returncode == 0:
            return ""
        lines = said.strip().splitlines() or [f"it {describe_exit(self._process.returncode)}"]
        return one_line(lines[-1]).removeprefix("gsbench: ")


def end_with(parent: int) -> None:
    """End this process soon after the process ``parent`` has ended, even if a tracker hangs."""

    def watch() -> None:
        while psutil.pid_exists(parent):
            time.sleep(1)
        time.sleep(SECONDS_AFTER_PARENT)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def permissions(values: dict[str, Any]) -> list[str]:
    """The names that the trial's command allowed, and the address of its tracker, which it knows.

    The command checked it: an address that only a file names needs permission.
    """
    address = values["tracking"].get("uri")
    names = [*(values.get("allow_targets") or ()), *([address] if address else [])]
    return list(dict.fromkeys(map(str, names)))


def _has_ended_since(folder: Path, since: float) -> bool:
    """Return whether the trial has ended; result files that are older are of an earlier run."""
    for name in (RESULTS, FAILED):
        with suppress(OSError):
            # a file system's clock may be some milliseconds late
            if os.stat(folder / name).st_mtime >= since - 0.05:
                return True
    return False
