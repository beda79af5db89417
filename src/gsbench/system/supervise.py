"""A process that stays behind its own child and ends whatever that child leaves running, daemons included.

A daemon forks twice and begins a session of its own: then neither its parent nor its process group leads to it. Linux
lets a process adopt all orphans among its descendants (PR_SET_CHILD_SUBREAPER), so that none can get away from it.
Elsewhere such a daemon does get away; what stays in the process group does not.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from contextlib import suppress

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
