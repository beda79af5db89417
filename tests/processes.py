"""Child processes of tests: their signals, whether they run, and the files that they write."""

from __future__ import annotations

import signal
from contextlib import suppress
from pathlib import Path

import psutil


def heed_interrupts() -> None:
    """Restore SIGINT in a child (``preexec_fn``): tests in the background of a shell ignore it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def is_running(pid: int) -> bool:
    """Return whether a process exists and has not ended; a zombie has ended."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def bytes_written(folder: Path, pattern: str) -> int:
    """Count the bytes in files of ``folder`` that match ``pattern``; files may vanish meanwhile."""
    total = 0
    for path in folder.glob(pattern):
        with suppress(FileNotFoundError):
            total += path.stat().st_size
    return total
