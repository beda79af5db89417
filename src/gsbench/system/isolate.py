"""Run a function in a process of its own, where a crash becomes an error with a reason.

The child is a fresh interpreter, not a fork, so it inherits no threads or locks. It imports only
what the function needs and never the parent's ``__main__``, so it works from console scripts,
notebooks, pytest and Hydra. The child and all programs that it starts end with the parent, even if
the parent is killed, and do not outlive the function. On Linux this includes daemons; on other
systems a program that starts its own session escapes.

For this, the child forks once: its own child runs the function, while it waits and then kills all
descendants. A daemon forks twice and starts its own session, so neither its parent nor its process
group identifies it. On Linux a process can adopt all orphans among its descendants
(PR_SET_CHILD_SUBREAPER), so none can escape.
"""

import ctypes
import json
import logging
import os
import pickle
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from logging.handlers import QueueHandler
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, TypeVar

from gsbench.errors import GsbenchError
from gsbench.logs import LOGGER, Progress, no_progress
from gsbench.system.programs import allowed_modules

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36  # linux/prctl.h
# time limit for descendants that SIGKILL does not end, such as those of another user
SECONDS_TO_END = 5.0
SECONDS_BETWEEN_LOOKS = 0.01
SIGNALLED = 128  # plus its number: the exit code of a process that a signal ended


def continue_in_child() -> bool:
    """Fork, and return True in the child.

    This process does not return: it waits for the child, kills all descendants, and ends with the
    exit code of the child, as shells count (`SIGNALLED`). All of them also end when the standard
    input of this process is closed, that is, when its parent is gone. Call it while there is only
    one thread. Returns False, in this process, on systems without fork.
    """
    if not hasattr(os, "fork"):
        return False
    child = os.fork()
    if child == 0:
        _control(PR_SET_PDEATHSIG, signal.SIGKILL)
        return True
    _control(PR_SET_CHILD_SUBREAPER, 1)
    # the child may end its whole process group and wait for it
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    ended = status = 0
    while ended != child:
        ended, status = os.waitpid(-1, 0)  # also reaps adopted orphans
    end_descendants()
    code = os.waitstatus_to_exitcode(status)
    os._exit(code if code >= 0 else SIGNALLED - code)


def end_descendants() -> None:
    """Kill all descendants of this process, again and again, since they may start others."""
    # not at the top: the import takes longer than many of the functions that run here
    import psutil

    deadline = time.monotonic() + SECONDS_TO_END
    while time.monotonic() < deadline:
        alive = []
        for process in psutil.Process().children(recursive=True):
            with suppress(psutil.Error):
                if process.status() != psutil.STATUS_ZOMBIE:
                    alive.append(process)
                    process.kill()
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        if not alive:
            return
        time.sleep(SECONDS_BETWEEN_LOOKS)


def _end_with_parent() -> None:
    while os.read(0, 1):
        pass
    if hasattr(os, "fork"):
        end_descendants()
        os.killpg(0, signal.SIGKILL)  # also this process, which leads the group
    os._exit(1)


def _control(option: int, value: int) -> None:
    """Call Linux's prctl; do nothing on other systems."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


T = TypeVar("T")

_BOOTSTRAP = (
    "import json, sys; path, own = json.loads(sys.argv[1]); sys.path[:] = path; "
    "from gsbench.system.programs import adopt_modules; adopt_modules(own); "
    "from gsbench.system.isolate import _child; _child()"
)
# time limit for a child to end the programs that it started, before it is killed
_SECONDS_TO_END = 10.0
_TAIL_LINES = 3
_TAIL_BYTES = 1 << 20  # the part of an output that is searched: a program may print gigabytes
_STACK_LINE = re.compile(r"^\s*(@|PC:|\*\*\* )|^\s*File |^\s*$")  # crash dumps of glog, blank lines
_REASON_LINE = re.compile(
    r"what\(\)|terminate called|Check failed|Error|error|free\(\)|malloc|corrupt"
)


class CrashError(GsbenchError):
    """An isolated function has no result: its process crashed, was killed, or ran out of memory."""


def run_isolated(
    function: Callable[..., T],
    *args: Any,
    what: str | None = None,
    log: Path | None = None,
    progress: Progress | None = None,
) -> T:
    """Return ``function(*args)``, computed in a fresh child process.

    ``function`` must be a top-level function of a module other than ``__main__``. The function, its
    arguments and its result are pickled. ``what`` names the work in errors ("undistortion"). The
    output of the child, also of native libraries, is appended to the file ``log``; without ``log``
    it is dropped on success. What the function logs is logged here. With ``progress``, its last
    argument is a `Progress` that is forwarded.

    An exception of the function is raised again here, with the child's traceback as a note. A crash
    of the process raises `CrashError`, whose message ends with the last error lines of the output.
    """
    what = what or function.__name__
    call = pickle.dumps((function, args, progress is not None))
    with log.open("ab+") if log else tempfile.TemporaryFile() as output:
        start = output.seek(0, os.SEEK_END)
        code, result = _run_child(call, output, progress or no_progress)
        if code != 0 or result is None:
            reason = error_tail(os.dup(output.fileno()), start)
            raise CrashError(f"{what} {describe_exit(code)}; its last lines: {reason}")
    succeeded, value, trace = result
    if succeeded:
        return value
    value.add_note(f"raised in the isolated process of {what}:\n{trace}")
    raise value


def _run_child(call: bytes, output: IO[bytes], progress: Progress) -> tuple[int, Any]:
    """Run the ``call`` in a child; returns its exit code and its result, None without one.

    It is ended on any exception, as Ctrl-C.
    """
    search_path = json.dumps([sys.path, allowed_modules()])
    # -P: a stranger's capture in the current folder may have a json.py, which must not be imported.
    command = [sys.executable, "-P", "-c", _BOOTSTRAP, search_path]
    # In its own session, the child does not receive Ctrl-C. The parent does and ends it: one
    # traceback, not two. After the call nothing is written to the pipe at stdin. When it closes,
    # the child ends, because the parent wants it or is gone.
    child = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=output,
        start_new_session=True,
    )
    assert child.stdin is not None
    assert child.stdout is not None
    result = None
    try:
        with suppress(EOFError, pickle.UnpicklingError, BrokenPipeError):  # the child has ended
            pickle.dump(call, child.stdin)
            child.stdin.flush()
            while True:
                content = pickle.load(child.stdout)
                if isinstance(content, logging.LogRecord):
                    logging.getLogger(content.name).handle(content)
                elif isinstance(content, dict):
                    with suppress(BrokenPipeError):  # a closed terminal must not stop the work
                        progress(**content)
                else:
                    result = content
        return child.wait(), result
    finally:
        with suppress(BrokenPipeError):
            child.stdin.close()
        child.stdout.close()
        try:
            child.wait(_SECONDS_TO_END if hasattr(os, "fork") else 0)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        if hasattr(os, "killpg"):  # programs that it left running in its session
            # raised if no process is left (on macOS: only zombies)
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(child.pid, signal.SIGKILL)


def _child() -> None:
    """The main function of the child, which gets the pickled call by its standard input.

    Log records, progress (a mapping) and the result go to its standard output, each pickled. What
    the function itself prints goes to standard error.
    """
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    call = pickle.load(sys.stdin.buffer)  # bytes: what they name is imported after the fork
    if not continue_in_child():
        threading.Thread(target=_end_with_parent, daemon=True).start()
    channel, one_at_a_time = os.fdopen(os.dup(1), "wb"), threading.Lock()
    os.dup2(2, 1)

    def send(content: Any) -> None:
        message = pickle.dumps(content)
        with one_at_a_time:
            channel.write(message)
            channel.flush()

    def report(phase: str, done: int, total: int | None, note: str = "") -> None:
        send({"phase": phase, "done": done, "total": total, "note": note})

    LOGGER.addHandler(QueueHandler(SimpleNamespace(put_nowait=send)))
    function, args, reports = pickle.loads(call)
    try:
        result = True, function(*args, *[report] * reports), ""
    except Exception as error:  # noqa: BLE001  raised again in the parent
        result = False, _portable(error), traceback.format_exc()
    send(result)
    sys.stdout.flush()
    sys.stderr.flush()
    # Native libraries are not unloaded, because they may crash then. The result is already sent.
    os._exit(0)


def _portable(error: Exception) -> Exception:
    """The error itself if it can be pickled, else a RuntimeError with its text."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # noqa: BLE001  the methods of its class may fail in any way
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def describe_exit(code: int) -> str:
    """Describe the unexpected end of a process by its exit code: ``crashed (SIGSEGV)``."""
    number = code - SIGNALLED if code > SIGNALLED else -code
    with suppress(ValueError):  # not the number of a signal
        name = signal.Signals(number).name
        return f"crashed ({name}{', perhaps out of memory' if name == 'SIGKILL' else ''})"
    return f"ended early (exit code {code})"


def error_tail(output: Path | int, start: int = 0) -> str:
    """`error_lines` of the end of an output (file or descriptor), from byte ``start`` on."""
    with open(output, "rb") as stream:
        stream.seek(max(start, stream.seek(0, os.SEEK_END) - _TAIL_BYTES))
        return error_lines(stream.read(_TAIL_BYTES))


def error_lines(output: bytes) -> str:
    """The last lines of a process's output that look like error messages, joined to one line."""
    lines = output.decode("utf-8", "replace").splitlines()
    lines = [line.strip() for line in lines if not _STACK_LINE.match(line)]
    errors = [line for line in lines if _REASON_LINE.search(line)] or lines
    return " | ".join(errors[-_TAIL_LINES:]) or "(no output)"
