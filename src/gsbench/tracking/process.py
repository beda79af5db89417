"""The process that talks to the tracker, as the trial's process sees it.

Why a process: a client of MLflow may hang in a socket, a lock or a C library for as long as the other side likes. A
thread that does so cannot be ended, and one that is inside a C library when the interpreter exits takes the whole
process down, after a trial that was complete. A process can be killed. Starting one and importing MLflow there takes
about two seconds of processor time, beside the trial; so it is kept for the next trial of this process.

Requests go to it as lines of JSON, answers come back the same way. The end of its input tells it that nobody listens
any more: it has `gsbench.tracking.child.SECONDS_AFTER_PARENT` seconds left, and then ends, whatever hangs.
"""

from __future__ import annotations

import atexit
import json
import queue
import subprocess
import tempfile
import threading
from contextlib import suppress
from types import TracebackType
from typing import Any

from gsbench.system.isolate import describe_exit, python_command, telling_lines

SECONDS_IN_VAIN = 10.0  # patience with a tracker that the last trial waited for in vain
SECONDS_TO_EXIT = 1.0  # patience with a process that has nothing to do and was told to end


class MirrorError(Exception):
    """The process ended by itself, or cannot be reached."""


class MirrorProcess:
    """A fresh interpreter that runs `gsbench.tracking.child.serve`."""

    def __init__(self) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - the process's for all its life
        self._process = subprocess.Popen(
            python_command("gsbench.tracking.child", "serve"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            start_new_session=True,  # Ctrl-C is for the trial, which then tells us
        )
        self._answers: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        # It reads a pipe and nothing else, and ends with the process, which `close` and `kill` see to.
        self._reader = threading.Thread(target=self._read, name="mlflow-mirror", daemon=True)
        self._reader.start()

    def __enter__(self) -> MirrorProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.kill()

    @property
    def is_alive(self) -> bool:
        return self._process.poll() is None

    def tell(self, do: str, **values: Any) -> None:
        """Send a request; where the process has ended, the next `ask` says so."""
        stdin = self._process.stdin
        assert stdin is not None
        with suppress(OSError, ValueError):  # a broken pipe, or one that was closed
            stdin.write(json.dumps({"do": do} | values).encode() + b"\n")
            stdin.flush()

    def ask(self, do: str, seconds: float | None, **values: Any) -> dict[str, Any]:
        """Send a request and wait for its answer. Raises TimeoutError, and MirrorError where the process has ended."""
        self.tell(do, **values)
        try:
            answer = self._answers.get(timeout=seconds)
        except queue.Empty:
            raise TimeoutError from None
        if answer is None:
            raise MirrorError(self._describe_end())
        return answer

    def close(self) -> None:
        """End it, which has nothing to do."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(SECONDS_TO_EXIT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join(SECONDS_TO_EXIT)
        self._errors.close()

    def kill(self) -> None:
        """End it, whatever it is at."""
        self._process.kill()
        self.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        # Unbuffered: at its exit, Python aborts where a thread is inside a buffered file.
        with open(self._process.stdout.fileno(), "rb", buffering=0, closefd=False) as answers:
            for line in answers:
                self._answers.put(json.loads(line))
        self._answers.put(None)

    def _describe_end(self) -> str:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(SECONDS_TO_EXIT)
        self._process.kill()
        code = self._process.wait()
        self._errors.seek(0)
        return f"the mirror {describe_exit(code)}; its last words: {telling_lines(self._errors.read())}"


class MirrorProcesses:
    """The processes that wait for the next trial of this one; more than one where trials ran in threads."""

    def __init__(self) -> None:
        self._idle: list[MirrorProcess] = []
        self._in_vain = False
        atexit.register(self._close)

    def take(self) -> MirrorProcess:
        """A process for one trial: one that is at hand, or a new one. Raises OSError where none can be started."""
        while self._idle:
            process = self._idle.pop()
            if process.is_alive:
                return process
            process.close()
        return MirrorProcess()

    def give_back(self, process: MirrorProcess) -> None:
        """Keep a process that answered."""
        self._in_vain = False
        self._idle.append(process)

    def give_up(self, process: MirrorProcess) -> None:
        """End a process that did not, however long it was waited for."""
        self._in_vain = True
        process.kill()

    def patience(self, seconds: float) -> float:
        """``seconds``, but few where the last trial waited in vain: a sweep does not lose them at each trial."""
        return min(seconds, SECONDS_IN_VAIN) if self._in_vain else seconds

    def _close(self) -> None:
        for process in self._idle:
            process.close()


processes = MirrorProcesses()
