"""The mirror as the trials see it: it starts the follower process, and at the end waits for it a bounded time.

Why a process: a tracker's client may hang in a socket, a lock or a C library for any time. A hanging thread cannot be
ended, and a thread that is inside a C library when the interpreter exits crashes the process, after a trial that was
complete. A process can be killed.

The follower gets the folders to follow on stdin, and reads everything else from files. Its exit code says how it ended,
and the last line on its stderr says why.
"""

from __future__ import annotations

import logging
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

from gsbench.system.isolate import describe_exit, error_lines, python_command
from gsbench.tracking.trial import name_of

log = logging.getLogger(__name__)

TRACKER_FAILED = 3  # exit code if the tracker, or a file, is at fault: the last line on stderr says why
SECONDS_TO_STOP = 3.0  # patience after a signal that asks to end


class MirrorError(Exception):
    """The error of a mirror that could not be written. Its text is the reason, in one line."""


class Mirror:
    """Mirrors the trials that begin within a ``with`` block, all by one process; none if it is ``idle``.

    At the end of the block, it waits a bounded time for the tracker. Errors of the tracker are never raised: one line
    in the log says what is missing.
    """

    def __init__(self, idle: bool = False) -> None:
        self._idle = idle
        self._process: subprocess.Popen[bytes] | None = None
        self._options: dict[str, Any] = {}

    def __enter__(self) -> Mirror:
        return self

    def follow(self, folder: Path, options: dict[str, Any]) -> None:
        """Mirror the trial in ``folder``, with the settings ``tracking``, from when it runs until it has ended."""
        if self._idle or not options["enabled"]:
            return
        self._options = options
        try:
            if self._process is not None and self._process.poll() is not None:
                self._finish(0)
            if self._process is None:
                self._process = self._start()
            assert self._process.stdin is not None
            self._process.stdin.write(f"{folder}\n".encode())
            self._process.stdin.flush()
        except OSError as error:
            self._warn(error)

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        stopped = kind is not None and not issubclass(kind, Exception)
        if self._process is not None:
            self._finish(SECONDS_TO_STOP if stopped else float(self._options["patience_seconds"]))

    def _start(self) -> subprocess.Popen[bytes]:
        """A fresh interpreter that runs `gsbench.tracking.follower.follow`. Raises OSError where it cannot start."""
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the process runs
        words = (str(self._options["flush_seconds"]), str(self._options["patience_seconds"]))
        return subprocess.Popen(
            python_command("gsbench.tracking.follower", "follow", *words),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,  # what MLflow prints
            stderr=self._errors,
            start_new_session=True,  # Ctrl-C must reach only the trials' process, which then ends this one
        )

    def _finish(self, seconds: float) -> None:
        """Close the process's input, wait for its end ``seconds`` at most, then kill it."""
        process, self._process = self._process, None
        assert process is not None
        try:
            process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            log.warning("tracking: %s is slow; `gsbench sync` mirrors the rest later", name_of(self._options))
            return
        finally:  # also where a signal interrupts the wait
            process.kill()
            process.wait()
            with suppress(OSError):
                process.stdin.close()  # type: ignore[union-attr]
            self._errors.seek(0)
            stderr = self._errors.read()
            self._errors.close()
        if process.returncode == TRACKER_FAILED:
            text = stderr.decode("utf-8", "replace").strip()
            log.debug("tracking failed:\n%s", text)
            self._warn(text.splitlines()[-1])
        elif process.returncode != 0:
            self._warn(f"the mirror {describe_exit(process.returncode)}; its last lines: {error_lines(stderr)}")

    def _warn(self, error: object) -> None:
        log.warning("tracking: %s; the files are complete, `gsbench sync` mirrors them later", error)
