"""Child processes of tests, and what they have written so far."""

from __future__ import annotations

import signal
from contextlib import suppress
from pathlib import Path

import psutil


def heed_interrupts() -> None:
    """For ``preexec_fn``: what runs in the background of a shell, as tests may, hands an ignored
    SIGINT on."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def is_running(pid: int) -> bool:
    """Whether there is such a process and it has not ended; one that nobody has waited for yet
    has."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def bytes_written(folder: Path, pattern: str) -> int:
    """Bytes in the files of ``folder`` that match ``pattern``, while their writer may rename or
    remove any of them."""
    total = 0
    for path in folder.glob(pattern):
        with suppress(FileNotFoundError):
            total += path.stat().st_size
    return total
