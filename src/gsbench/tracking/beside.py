"""`gsbench sync --beside`: one process beside a sweep, which sends to trackers what trials write.

Why a process: a tracker's client may hang in a socket, a lock or a C library for any time, and
crash the interpreter when it exits. A process can be killed, and harms no trial. It lives as long
as the sweep, because importing MLflow takes 4 CPU-seconds, and a send a tenth of one.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from gsbench.parsing import one_line
from gsbench.runs.layout import FAILED, RESULTS
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.isolate import describe_exit
from gsbench.system.programs import allow_modules, safe_environment
from gsbench.tracking.sync import MirrorError, sync

log = logging.getLogger(__name__)

SECONDS_TO_STOP = 3.0  # patience after a signal that asks to end
SECONDS_BETWEEN_SENDS = 5.0  # at least, however many trials end
SLOW = "the tracker is slow"
SOON = "\n"  # the line that asks the process to send soon


class Mirror:
    """Sends the trials that begin within a ``with`` block to their trackers; ``idle``: sends none.

    While the block runs, a process sends every ``tracking.flush_seconds``, and soon after a trial
    has ended; at the end it gets ``tracking.patience_seconds``. Errors of a tracker are never
    raised: one line in the log says what is missing.
    """

    _process: subprocess.Popen[bytes] | None = None
    _said: IO[bytes]  # the process's error output
    _patience = 0.0
    _fault = ""

    def __init__(self, idle: bool = False) -> None:
        self._idle = idle
        self._lines: list[str] = []  # what the process is told of each trial
        self._unsent = b""  # what the pipe has not taken yet of these and of `SOON`

    def __enter__(self) -> Mirror:
        return self

    def follow(self, folder: Path, values: dict[str, Any]) -> None:
        """Mirror the trial in ``folder`` with the configuration ``values`` from start to end."""
        tracking = values["tracking"]
        if self._idle or not tracking["enabled"]:
            return
        self._patience = float(tracking["patience_seconds"])
        told = {"folder": str(folder), "since": time.time(), "pause": tracking["flush_seconds"]}
        self._lines.append(json.dumps(told | {"allowed": permissions(values)}) + "\n")
        self._tell(self._lines[-1])

    def trial_ended(self) -> None:
        """Send soon, since a trial has ended."""
        if self._lines:
            self._tell(SOON)

    def _tell(self, line: str) -> None:
        """Write a line to the process; one that has crashed is replaced, and told all again."""
        self._unsent += line.encode()
        if self._process is None or self._process.poll() is not None:
            try:
                self._process = self._started()
            except OSError as error:
                self._fault = str(error)
                return
            self._fault, self._unsent = "", "".join([*self._lines, SOON]).encode()
        self._write(self._process)

    def _write(self, process: subprocess.Popen[bytes]) -> None:
        """Write what the pipe takes. It does not block: a process that hangs delays no trial."""
        with suppress(BrokenPipeError):  # it has just crashed
            # a full pipe takes a part, or nothing (None)
            while sent := process.stdin.write(self._unsent):  # type: ignore[union-attr]
                self._unsent = self._unsent[sent:]

    def _started(self) -> subprocess.Popen[bytes]:
        runs = TrialFolder(Path(json.loads(self._lines[0])["folder"])).runs
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - until the process ends
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "gsbench", "sync", f"--beside={self._patience}"],
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._said,
            env=safe_environment() | {"GSBENCH_RUNS": str(runs)},
            # Ctrl-C must reach only the trials' process, which then ends this one
            start_new_session=True,
        )
        with suppress(AttributeError):  # Windows, before Python 3.12
            os.set_blocking(process.stdin.fileno(), False)  # type: ignore[union-attr]
        return process

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        if (process := self._process) is not None:
            is_stopped = kind is not None and not issubclass(kind, Exception)
            try:
                self._write(process)
                process.stdin.close()  # type: ignore[union-attr]
                process.wait(min(self._patience, SECONDS_TO_STOP) if is_stopped else self._patience)
                late = SLOW if self._unsent else ""
                self._fault = self._fault or self._reason(process.returncode) or late
            except subprocess.TimeoutExpired:
                self._fault = SLOW
            finally:  # also where a signal interrupts the wait
                process.kill()
                process.wait()
        if self._fault:
            log.warning(
                "tracking: %s; the files are complete, `gsbench sync` sends them later", self._fault
            )

    def _reason(self, code: int) -> str:
        """The reason of a failure of the process that ended with the exit code; else ""."""
        self._said.seek(0)
        said = self._said.read().decode(errors="replace")
        log.debug("gsbench sync: %s", said)
        lines = said.strip().splitlines() or [f"it {describe_exit(code)}"]
        return one_line(lines[-1]).removeprefix("gsbench: ") if code else ""


def send_beside(lines: Iterable[str], patience: float) -> None:
    """Send the trials that ``lines`` name, as `Mirror` writes them, until these end.

    Then all are sent once more; if that takes longer than ``patience`` seconds, the process ends.
    So it ends soon after the sweep, even if that was killed. Raises the error of the last send.
    """
    followed: list[dict[str, Any]] = []
    wake, stop = threading.Event(), threading.Event()

    def read() -> None:
        try:
            for line in lines:
                if line == SOON:
                    wake.set()
                else:
                    followed.append(json.loads(line))
        finally:  # also if a sweep that was killed left a part of a line
            stop.set()
            wake.set()
            time.sleep(min(patience, threading.TIMEOUT_MAX))
            os._exit(1)

    threading.Thread(target=read, daemon=True).start()
    is_last, fault = False, None
    while not is_last:
        pause = min((one["pause"] for one in followed), default=1.0)
        wake.wait(pause)
        wake.clear()
        is_last = stop.is_set()
        fault = _send(followed)
        stop.wait(min(pause, SECONDS_BETWEEN_SENDS))
    if fault is not None:
        raise fault


def _send(followed: list[dict[str, Any]]) -> Exception | None:
    """Send the followed trials, and forget those that have ended; returns a tracker's error."""
    begun = [one for one in list(followed) if Path(one["folder"]).is_dir()]
    ended = [one for one in begun if _has_ended_since(Path(one["folder"]), one["since"])]
    allowed = [name for one in begun for name in one["allowed"]]
    allow_modules(allowed)
    try:
        for line in sync([TrialFolder(Path(one["folder"])) for one in begun], None, allowed):
            log.debug(line)
    except (MirrorError, OSError) as error:
        return error
    for one in ended:
        followed.remove(one)
    return None


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
