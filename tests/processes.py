"""Child processes of tests."""

from __future__ import annotations

import signal


def heed_interrupts() -> None:
    """For ``preexec_fn``: what runs in the background of a shell, as tests may, hands an ignored SIGINT on."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
