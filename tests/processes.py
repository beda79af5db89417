"""Child processes of tests: their signals, whether they run, and the files that they write."""

import signal
import subprocess
import time
from contextlib import suppress

import psutil


def completed(command, code=0, **options):
    """Run a command to its end and return it with its output as text.

    Its exit code must be ``code``, unless that is None.
    """
    options = {"capture_output": True, "text": True, "timeout": 600} | options
    done = subprocess.run([*map(str, command)], check=False, **options)
    assert code in (None, done.returncode), done.stderr
    return done


def heed_interrupts():
    """Restore SIGINT in a child (``preexec_fn``): tests in the background of a shell ignore it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def is_running(pid):
    """Return whether a process exists and has not ended; a zombie has ended."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def wait_until(condition, seconds=300, pause=0.01):
    """Wait until ``condition()`` holds; the limit is for programs that hang."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(pause)


def bytes_written(folder, pattern):
    """Count the bytes in files of ``folder`` that match ``pattern``; files may vanish meanwhile."""
    total = 0
    for path in folder.glob(pattern):
        with suppress(FileNotFoundError):
            total += path.stat().st_size
    return total
