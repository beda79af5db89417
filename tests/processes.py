"""Child processes of tests, and what they have written so far."""

from __future__ import annotations

import signal
from contextlib import suppress
from pathlib import Path


def heed_interrupts() -> None:
    """For ``preexec_fn``: what runs in the background of a shell, as tests may, hands an ignored SIGINT on."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def bytes_written(folder: Path, pattern: str) -> int:
    """Bytes in the files of ``folder`` that match ``pattern``, while their writer may rename or remove any of them."""
    total = 0
    for path in folder.glob(pattern):
        with suppress(FileNotFoundError):
            total += path.stat().st_size
    return total
