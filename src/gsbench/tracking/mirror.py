"""The side of the trials: a process beside them follows their files; at the end it is waited for, a bounded time.

Why a process: a tracker's client may hang in a socket, a lock or a C library for as long as the other side likes. A
thread that does so cannot be ended, and one that is inside a C library when the interpreter exits takes the whole
process down, after a trial that was complete. A process can be killed.

It is told which folders to follow, and finds all else in files. How it ended is its exit code, and why is the last line
of what it wrote to stderr.
"""

from __future__ import annotations

import logging
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.isolate import describe_exit, python_command, telling_lines
from gsbench.tracking.client import untyped_address
from gsbench.tracking.sink import name_of
from gsbench.words import counted

log = logging.getLogger(__name__)

TRACKER_FAILED = 3  # exit code where the tracker, or a file, is at fault: the last line on stderr says why
SECONDS_TO_STOP = 3.0  # patience where a signal asks to end


class Mirror:
    """Mirrors the trials that begin while the ``with`` block runs, all by one process; none if it is ``idle``.

    On leaving it, the tracker is waited for a bounded time. Whatever the tracker does, nothing is raised: one line in
    the log says what is missing.
    """

    def __init__(self, idle: bool = False) -> None:
        self._idle = idle
        self._process: FollowerProcess | None = None
        self._options: dict[str, Any] = {}

    def __enter__(self) -> Mirror:
        return self

    def follow(self, folder: Path, options: dict[str, Any]) -> None:
        """Mirror the trial in ``folder``, with the settings ``tracking``, from when it runs until it has ended."""
        if self._idle or not options["enabled"]:
            return
        program = Path(sys.argv[0]).name or "python"
        self._options = options
        try:
            if self._process is not None and self._process.has_ended():
                self._finish(0)
            if self._process is None:
                self._process = FollowerProcess(program, options["flush_seconds"], options["patience_seconds"])
            self._process.tell(str(folder))
        except OSError as error:
            self._warn(error)

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        stopped = kind is not None and not issubclass(kind, Exception)
        if self._process is not None:
            self._finish(SECONDS_TO_STOP if stopped else float(self._options["patience_seconds"]))

    def _finish(self, seconds: float) -> None:
        process, self._process = self._process, None
        try:
            if process is not None:
                process.finish(seconds)
        except TimeoutError:
            log.warning("tracking: %s is slow; `gsbench sync` mirrors the rest later", name_of(self._options))
        except MirrorError as broken:
            self._warn(broken)

    def _warn(self, error: object) -> None:
        log.warning("tracking: %s; the files are complete, `gsbench sync` mirrors them later", error)


def sync(folders: Iterable[TrialFolder], uri: str | None) -> Iterator[str]:
    """Mirror what the tracker missed of ended trials; yields a line for each that is new there or left out, and one
    for all.

    Raises MirrorError where the tracker does not take it.
    """
    places = []
    for folder in folders:
        state = folder.state()
        if state == "damaged":
            yield f"left out: {folder.label}: damaged, see gsbench status"
        if state not in ("done", "failed"):
            continue
        try:
            options = folder.configuration()["tracking"]
        except InputError as error:
            yield f"left out: {error}"
            continue
        # A runs folder of somebody else's must not send what is here, or our passwords, to an address of theirs.
        if strange := untyped_address(options | ({"uri": uri} if uri else {}), uri):
            yield (
                f"left out: {folder.label}: its configuration names the tracker {strange}, and --uri {strange} was "
                "not typed"
            )
            continue
        places.append(str(folder.path))
    process = FollowerProcess("", 1.0, 0.0, uri)
    try:
        new = 0
        for line in process.lines(places):
            new += line.startswith("mirrored")
            if line:
                yield line
        process.finish(None)
        yield f"{counted(new, 'trial')} mirrored now, {len(places) - new} before"
    finally:
        process.kill()  # Ctrl-C ends it, whatever the tracker does


class MirrorError(Exception):
    """Error of a mirror that could not be written; the text is the reason, in one line."""


class FollowerProcess:
    """A fresh interpreter that runs `gsbench.tracking.follower.follow`. Raises OSError where it cannot start."""

    def __init__(self, program: str, pause: float, patience: float, uri: str | None = None) -> None:
        words = (program, str(pause), str(patience), uri or "")
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - the process's for all its life
        self._process = subprocess.Popen(
            python_command("gsbench.tracking.follower", "follow", *words),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            start_new_session=True,  # Ctrl-C is for the trial, which then ends us
        )

    def tell(self, line: str) -> None:
        """Write a line to the process's input."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n".encode())
        self._process.stdin.flush()

    def has_ended(self) -> bool:
        """Return whether the process is gone."""
        return self._process.poll() is not None

    def lines(self, told: Iterable[str]) -> Iterator[str]:
        """The lines that it prints, until it ends, when it is ``told`` these and no more."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with suppress(BrokenPipeError):  # how it ended is said in `finish`
            for line in (*told, ""):
                self.tell(line)
        for said in self._process.stdout:
            yield said.decode("utf-8", "replace").rstrip("\n")

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
            raise MirrorError(f"the mirror {describe_exit(code)}; its last lines: {telling_lines(said)}")

    def kill(self) -> None:
        """End the process, whatever it is doing."""
        if not self.has_ended():
            self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with suppress(OSError):
                    stream.close()
