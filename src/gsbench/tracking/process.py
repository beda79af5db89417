"""A process that reads trials' files and talks to a tracker, as the process that started it sees it.

Why a process: a tracker's client may hang in a socket, a lock or a C library for as long as the other side likes. A
thread that does so cannot be ended, and one that is inside a C library when the interpreter exits takes the whole
process down, after a trial that was complete. A process can be killed.

Nothing is said to it but the end: it is given its input for life, and finds all else in files. How it ended is its exit
code, and why is the last line of what it wrote to stderr.
"""

from __future__ import annotations

import logging
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import suppress

from gsbench.system.isolate import describe_exit, python_command, telling_lines

log = logging.getLogger(__name__)

TRACKER_FAILED = 3  # exit code where the tracker, or a file, is at fault: the last line on stderr says why


class MirrorError(Exception):
    """Error of a mirror that could not be written; the text is the reason, in one line."""


class MirrorProcess:
    """A fresh interpreter that runs a function of `gsbench.tracking.follower`. Raises OSError where it cannot start."""

    def __init__(self, function: str, *arguments: str) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - the process's for all its life
        self._process = subprocess.Popen(
            python_command("gsbench.tracking.follower", function, *arguments),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            start_new_session=True,  # Ctrl-C is for the trial, which then ends us
        )

    def lines(self) -> Iterator[str]:
        """The lines that it prints, until it ends."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            yield line.decode("utf-8", "replace").rstrip("\n")

    def finish(self, seconds: float | None) -> None:
        """Tell the process that its input has ended, and wait for its own end.

        Raises TimeoutError where it takes longer than ``seconds``, and MirrorError where it failed. In each case, and
        where a signal interrupts the wait, it is gone afterwards.
        """
        try:
            self._process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            raise TimeoutError from None
        finally:
            self.kill()
            self._errors.seek(0)
            said = self._errors.read()
            self._errors.close()
        code = self._process.returncode
        if code == TRACKER_FAILED:
            text = said.decode("utf-8", "replace").strip()
            log.debug("tracking failed:\n%s", text)
            raise MirrorError(text.splitlines()[-1])
        if code != 0:
            raise MirrorError(f"the mirror {describe_exit(code)}; its last words: {telling_lines(said)}")

    def kill(self) -> None:
        """End the process, whatever it is doing."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with suppress(OSError):
                    stream.close()
