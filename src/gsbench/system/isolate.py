"""Run a function in a process of its own, so that a crash in native code becomes an error with a reason.

The child is a fresh interpreter (never a fork, so no threads or locks are inherited) that imports only what the
function needs: the parent's ``__main__`` is not imported again, so it works alike from a console script, a notebook,
pytest and Hydra. The child, and every program that it started, ends when the parent does, even when the parent is
killed; no such program outlives the function. On Linux that holds for daemons too; on other systems a program that
begins a session of its own gets away.

The process stays behind its own child and ends whatever that leaves running. A daemon forks twice and begins a
session of its own: then neither its parent nor its process group leads to it. Linux lets a process adopt all orphans
among its descendants (PR_SET_CHILD_SUBREAPER), so that none can get away from it.
"""

import ctypes
import json
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
from pathlib import Path
from typing import Any, BinaryIO, ParamSpec, TypeVar

from gsbench.errors import GsbenchError
from gsbench.logs import Progress
from gsbench.system.own_modules import allowed_modules

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36  # linux/prctl.h
SECONDS_TO_END = 5.0  # patience with descendants that do not die of SIGKILL, such as those of another user
SECONDS_BETWEEN_LOOKS = 0.01


def go_on_as_child() -> bool:
    """Return in a child of this process, which itself never returns: it ends as the child does, and all with it.

    All ends too where the input of this process does, that is where its parent is gone. To be called while there is one
    thread. Returns False, in this process, where the system has no fork.
    """
    if not hasattr(os, "fork"):
        return False
    child = os.fork()
    if child == 0:
        _control(PR_SET_PDEATHSIG, signal.SIGKILL)
        return True
    _control(PR_SET_CHILD_SUBREAPER, 1)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # the child may ask its whole process group to end, and wait for it
    threading.Thread(target=_end_with_parent, daemon=True).start()
    status = 0
    ended = 0
    while ended != child:
        ended, status = os.waitpid(-1, 0)  # adopted orphans are waited for as well
    end_descendants()
    _exit_as(os.waitstatus_to_exitcode(status))
    return True


def end_descendants() -> None:
    """Kill every process that descends from this one; more than once, since they may start others meanwhile."""
    import psutil  # here: its import takes longer than many a function that is supervised

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
    end_descendants()
    os.killpg(0, signal.SIGKILL)  # this process too, which leads the group


def _exit_as(code: int) -> None:
    """End as a child did whose exit code was ``code`` (negative: by a signal)."""
    if code < 0:
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # the child has left its core, if any was wanted
        with suppress(OSError):
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


def _control(option: int, value: int) -> None:
    """Linux's prctl; nothing elsewhere."""
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

_BOOTSTRAP = (
    "import json, sys; path, own = json.loads(sys.argv[1]); sys.path[:] = path; "
    "from gsbench.system.own_modules import take_over; take_over(own); from {module} import {name}; {name}()"
)
_SECONDS_TO_END = 10.0  # patience with a child that ends what it started, before it is killed
_TAIL_LINES = 3
_TAIL_BYTES = 1 << 20  # in which they are looked for: a program may print gigabytes
_STACK_LINE = re.compile(r"^\s*(@|PC:|\*\*\* )|^\s*File |^\s*$")  # glog's crash dump, blank lines
_REASON_LINE = re.compile(r"what\(\)|terminate called|Check failed|Error|error|free\(\)|malloc|corrupt")


class CrashError(GsbenchError):
    """Error of an isolated function without a result: its process crashed, was killed, or ran out of memory."""


def run_isolated(
    function: Callable[..., R],
    *args: Any,
    what: str | None = None,
    log: Path | None = None,
    **kwargs: Any,
) -> R:
    """Return ``function(*args, **kwargs)``, computed in a fresh child process.

    ``function`` must be importable by name (a top-level function of a module, not of ``__main__``); it, the arguments
    and the result travel by pickle. ``what`` names the work in errors ("undistortion"). The child's whole output, that
    of native libraries included, is appended to the file ``log`` if one is given, else dropped on success.

    An exception that the function raises is raised here again, with the child's traceback as a note. A crash of the
    process raises `CrashError`, one line that ends with the last telling lines of its output.
    """
    what = what or function.__name__
    if function.__module__ == "__main__" or "<" in function.__qualname__:
        raise ValueError(f"run_isolated: {function.__qualname__} must be a top-level function of an importable module")
    with tempfile.TemporaryDirectory(prefix="gsbench-isolate-") as folder:
        call, result = Path(folder, "call.pickle"), Path(folder, "result.pickle")
        call.write_bytes(pickle.dumps((function, args, kwargs)))
        output = log if log is not None else Path(folder, "output.txt")
        with output.open("ab") as stream:
            start = stream.seek(0, os.SEEK_END)
            code = _run_child(call, result, stream)
        if code != 0 or not result.is_file():
            raise CrashError(f"{what} {describe_exit(code)}; its last lines: {telling_tail(output, start)}")
        succeeded, value, trace = pickle.loads(result.read_bytes())
    if succeeded:
        return value
    value.add_note(f"raised in the isolated process of {what}:\n{trace}")
    raise value


POLL_SECONDS = 0.25


class ProgressFile:
    """A `Progress` that writes to a file, for a process to tell its parent; small enough writes are atomic."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __call__(self, phase: str, done: int, total: int | None, note: str = "") -> None:
        with self.path.open("a", encoding="utf-8") as file:
            file.write(f"{phase}\t{done}\t{'' if total is None else total}\t{note}\n")


def run_with_progress(
    function: Callable[[Any, Progress], T], job: Any, progress: Progress, what: str, log: Path | None = None
) -> T:
    """``function(job, progress)`` in a fresh process (see `run_isolated`); its progress is passed on as it comes."""
    with tempfile.TemporaryDirectory(prefix="gsbench-progress-") as folder:
        channel = ProgressFile(Path(folder, "progress.txt"))
        channel.path.touch()
        ended = threading.Event()
        listener = threading.Thread(target=_listen, args=(channel.path, progress, ended), daemon=True)
        listener.start()
        try:
            return run_isolated(function, job, channel, what=what, log=log)
        finally:
            ended.set()
            listener.join()


def _listen(path: Path, progress: Progress, ended: threading.Event) -> None:
    rest = ""
    with path.open(encoding="utf-8") as file:
        while True:
            last = ended.wait(POLL_SECONDS)
            *lines, rest = (rest + file.read()).split("\n")
            for line in lines:
                phase, done, total, note = line.split("\t")
                with suppress(BrokenPipeError):  # a closed terminal must not end the work
                    progress(phase, int(done), int(total) if total else None, note)
            if last:
                return


def python_command(module: str, name: str, *arguments: str) -> list[str]:
    """A fresh interpreter that finds the modules which this one finds, and calls the function ``name`` of ``module``.

    The function takes nothing; it finds ``arguments`` in ``sys.argv[2:]``.
    """
    found = json.dumps([sys.path, allowed_modules()])
    # -P: the current folder, in which a capture may lie, is no place to look in, not for json either.
    return [sys.executable, "-P", "-c", _BOOTSTRAP.format(module=module, name=name), found, *arguments]


def _run_child(call: Path, result: Path, output: BinaryIO) -> int:
    """Start the child, wait for it and return its exit code; end it on any exception here (Ctrl-C included)."""
    command = python_command("gsbench.system.isolate", "_child", str(call), str(result))
    # A session of its own: Ctrl-C reaches the parent only, which then ends the child: one traceback, not two.
    # stdin is a pipe that is never written: its end tells the child that it is to end, or that the parent is gone.
    child = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
    )
    try:
        return child.wait()
    finally:
        assert child.stdin is not None
        child.stdin.close()
        try:
            child.wait(_SECONDS_TO_END if hasattr(os, "fork") else 0)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
        _end_group(child.pid)


def _end_group(leader: int) -> None:
    """End what the child started and left behind: its session is the process group ``leader``."""
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError, PermissionError):  # nobody is left (macOS: only the dead are)
            os.killpg(leader, signal.SIGKILL)


def _child() -> None:
    """The child's whole life: arguments are the paths of the pickled call and of the result to write."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if not go_on_as_child():
        threading.Thread(target=_exit_with_parent, daemon=True).start()
    call, result = Path(sys.argv[2]), Path(sys.argv[3])
    function, args, kwargs = pickle.loads(call.read_bytes())
    try:
        outcome = (True, function(*args, **kwargs), "")
    except Exception as error:  # noqa: BLE001  whatever it is, it is raised again in the parent
        outcome = (False, _portable(error), traceback.format_exc())
    result.write_bytes(pickle.dumps(outcome))
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # native libraries may crash while they are unloaded; the result is already safe


def _exit_with_parent() -> None:
    while os.read(0, 1):
        pass
    os._exit(1)


def _portable(error: Exception) -> Exception:
    """The error itself if it survives pickling, else a RuntimeError with its text."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # noqa: BLE001  a class may fail in any way in its own reduce or init
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def describe_exit(code: int) -> str:
    """Describe the unexpected end of a process by its exit code: "crashed (SIGSEGV)", "ended early (exit code 1)"."""
    if code < 0:
        try:
            name = signal.Signals(-code).name
        except ValueError:
            name = f"signal {-code}"
        return f"crashed ({name}{', perhaps out of memory' if name == 'SIGKILL' else ''})"
    return f"ended early (exit code {code})"


def telling_tail(output: Path, start: int = 0) -> str:
    """`telling_lines` of the end of a file of output, of which what is before ``start`` does not count."""
    with output.open("rb") as stream:
        stream.seek(max(start, stream.seek(0, os.SEEK_END) - _TAIL_BYTES))
        return telling_lines(stream.read(_TAIL_BYTES))


def telling_lines(output: bytes) -> str:
    """The last lines of a process's output that look like a reason, on one line."""
    lines = output.decode("utf-8", "replace").splitlines()
    lines = [line.strip() for line in lines if not _STACK_LINE.match(line)]
    telling = [line for line in lines if _REASON_LINE.search(line)] or lines
    return " | ".join(telling[-_TAIL_LINES:]) or "(no output)"
