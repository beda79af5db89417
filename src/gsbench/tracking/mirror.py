"""A trial's side of the mirror: a process beside it follows its files; at the end it is waited for, a bounded time.

Why a process: a tracker's client may hang in a socket, a lock or a C library for as long as the other side likes. A
thread that does so cannot be ended, and one that is inside a C library when the interpreter exits takes the whole
process down, after a trial that was complete. A process can be killed.

Nothing is said to it but the end: it is given its input for life, and finds all else in files. How it ended is its exit
code, and why is the last line of what it wrote to stderr.
"""

from __future__ import annotations

import logging
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

from gsbench.system.isolate import describe_exit, python_command, telling_lines
from gsbench.tracking.sink import name_of

log = logging.getLogger(__name__)

TRACKER_FAILED = 3  # exit code where the tracker, or a file, is at fault: the last line on stderr says why
SECONDS_TO_STOP = 3.0  # patience where a signal asks to end
SECONDS_IN_VAIN = 10.0  # patience with a tracker that the last trial waited for in vain


class Mirror:
    """Mirrors the trial in ``folder``, which has its ``config.yaml``, while the ``with`` block runs.

    On leaving it, the tracker is waited for a bounded time: a sweep does not lose all of it at each trial where it was
    in vain before. Whatever the tracker does, nothing is raised: one line in the log says what is missing.
    """

    in_vain: ClassVar[bool] = False  # whether the last trial of this process waited for nothing

    def __init__(self, options: dict[str, Any], folder: Path) -> None:
        self._options, self._folder = options, folder
        self._process: MirrorProcess | None = None

    def __enter__(self) -> Mirror:
        if self._options["enabled"]:
            program = Path(sys.argv[0]).name or "python"
            try:
                self._process = MirrorProcess("follow", str(self._folder), program)
            except OSError as error:
                self._warn(error)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        if self._process is None:
            return
        stopped = kind is not None and not issubclass(kind, Exception)
        try:
            self._process.finish(SECONDS_TO_STOP if stopped else self._patience())
        except TimeoutError:
            Mirror.in_vain = True
            log.warning("tracking: %s is slow; `gsbench sync` mirrors the rest of %s later", self._name, self._folder)
        except MirrorError as broken:
            self._warn(broken)
        else:
            Mirror.in_vain = False

    def _patience(self) -> float:
        seconds = float(self._options["patience_seconds"])
        return min(seconds, SECONDS_IN_VAIN) if Mirror.in_vain else seconds

    @property
    def _name(self) -> str:
        return name_of(self._options)

    def _warn(self, error: object) -> None:
        log.warning("tracking: %s; the files are complete, `gsbench sync` mirrors them later", error)


def sync(homes: Sequence[Path], uri: str | None, anew: bool) -> Iterator[str]:
    """Mirror what the tracker missed of the experiments in ``homes``; yields a line for each trial and one for all.

    With ``anew``, what the tracker shows is deleted first. Raises MirrorError where the tracker does not take it.
    """
    process = MirrorProcess("sync", uri or "", "anew" if anew else "", *map(str, homes))
    try:
        yield from process.lines()
        process.finish(None)
    finally:
        process.kill()  # Ctrl-C ends it, whatever the tracker does


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
